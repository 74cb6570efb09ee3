"""Surfaces as people have them, made into scenes or refused in a sentence."""

from pathlib import Path

import numpy as np
import pytest

from app.scenes.new_scene import create_scene
from odd_surfaces import (
    Mesh,
    capped,
    domed,
    from_voxels,
    hairpin,
    joined,
    straight,
    swept,
    wall_solid,
    with_branch,
    write_stl,
)
from taichi_sph.assemble import initial_state
from taichi_sph.errors import InputError
from taichi_sph.geometry.findings import check_gaps, check_gravity
from taichi_sph.geometry.openings import close_holes, find_openings
from taichi_sph.geometry.vessel import Vessel, build_vessel, read_vessel
from taichi_sph.scene import OpeningTable, Scene, read_scene

SPACING = 0.9e-3
"""Of the blood in the hairpins, as given [m]."""


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def made(tmp_path: Path, surface: Mesh, **options) -> tuple[str, Scene, Vessel]:
    text = create_scene(write_stl(tmp_path / "my.stl", surface), tmp_path / "out", **options)
    scene = read_scene(tmp_path / "out" / "scene.toml")
    return text, scene, read_vessel(scene)


def refused(tmp_path: Path, surface: Mesh, **options) -> str:
    with pytest.raises(InputError) as error:
        create_scene(write_stl(tmp_path / "my.stl", surface), tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()
    return str(error.value)


# Caps that are not flat


@pytest.mark.parametrize("bulge", [0.002, 0.005, 0.02, 0.04, 0.1])
@pytest.mark.parametrize("rings", [1, 2, 3, 5])
def test_caps_that_bulge_are_openings(bulge: float, rings: int, tmp_path: Path) -> None:
    _, scene, vessel = made(tmp_path, domed(bulge, bulge, rings))
    # A polygon of 16 corners has this share of its circle's area.
    radius = 4e-3 * np.sqrt(np.sin(np.pi / 8) / (np.pi / 8))
    assert [o.radius for o in vessel.openings] == pytest.approx([radius] * 2, rel=0.01)
    blood = initial_state(scene, vessel).blood
    assert len(blood) >= 3000
    assert vessel.count_leaks(blood) == 0


def test_a_displaced_middle_and_one_dome_beside_a_flat_cap_are_openings(tmp_path: Path) -> None:
    for k, surface in enumerate((domed(0.03, 0.0, aside=0.5), domed(0.0, 0.1, 3))):
        folder = tmp_path / str(k)
        folder.mkdir()
        text, _, vessel = made(folder, surface)
        assert len(vessel.openings) == 2
        assert "made flat: 1 caps" in text


@pytest.mark.parametrize(
    ("surface", "words"),
    [
        (domed(0.0, 0.5, 3), ["(", "40)", "bulges by", "cut it flat or leave it open"]),
        (domed(0.0, 1.5, 4), ["only one opening", "closed and rounded off"]),
        (domed(1.5, 1.5, 4), ["no opening found", "closed and rounded off"]),
    ],
)
def test_an_end_that_is_a_dome_is_refused_by_its_place(
    surface: Mesh, words: list[str], tmp_path: Path
) -> None:
    text = refused(tmp_path, surface)
    assert all(word in text for word in words)


def test_a_little_noise_moves_no_opening(tmp_path: Path) -> None:
    vertices, faces = domed(0.0, 0.0, 4, around=32)
    vertices = vertices + 0.03 * np.random.default_rng(0).normal(size=vertices.shape)
    _, _, vessel = made(tmp_path, (vertices, faces))
    assert [1e3 * o.radius for o in vessel.openings] == pytest.approx([3.98] * 2, rel=0.015)


# A thin branch on a thick vessel


@pytest.mark.parametrize("closed", [True, False])
def test_a_thin_branch_is_found_capped_or_open(closed: bool) -> None:
    vertices, faces = with_branch(10.0, 0.9, 7.2)
    if closed:
        vertices, faces = capped(vertices, faces)
    vertices, faces, holes = close_holes(vertices, faces, "aorta")
    assert len(holes) == (0 if closed else 3)
    ends = find_openings(vertices, faces, holes, "aorta", search="both")
    assert [c.radius for c in ends.found] == pytest.approx([9.94, 9.94, 0.88], rel=0.01)
    assert ends.doubtful == ends.blind == []


@pytest.mark.validation
@pytest.mark.parametrize("closed", [True, False])
def test_a_column_made_fine_by_a_thin_branch_is_said(closed: bool, tmp_path: Path) -> None:
    surface = with_branch(10.0, 0.9, 7.2)
    text, _, vessel = made(tmp_path, capped(*surface) if closed else surface)
    assert [1e3 * o.radius for o in vessel.openings] == pytest.approx([9.94, 9.94, 0.88], rel=0.01)
    assert "sets the spacing" in text
    assert "opening_3" in text
    assert "--spacing" in text


@pytest.mark.validation
def test_a_branch_too_thin_for_any_column_is_written_as_capped(tmp_path: Path) -> None:
    text, _, vessel = made(tmp_path, with_branch(10.0, 0.4, 3.0))
    assert [o.is_open for o in vessel.openings] == [True, True, False]
    assert "opening_3" in text
    assert "is written as capped" in text


def test_an_opening_too_thin_for_the_spacing_given_is_written_as_capped(tmp_path: Path) -> None:
    text, _, vessel = made(tmp_path, with_branch(5.0, 1.0, 4.0), spacing=1e-3)
    assert [o.is_open for o in vessel.openings] == [True, True, False]
    assert "particles across it are too few" in text


# The wall as a solid


@pytest.mark.parametrize("bore", [0.3, 1.0, 2.5, 4.0, 4.8])
def test_the_solid_of_a_wall_is_refused(bore: float, tmp_path: Path) -> None:
    solid = wall_solid(straight(40.0, 5.0), straight(40.0, bore), 16)
    assert "has a hole in it: this is a wall, not a lumen" in refused(tmp_path, solid)


@pytest.mark.parametrize("closed", [True, False])
def test_a_shell_within_a_shell_is_refused(closed: bool, tmp_path: Path) -> None:
    outer, inner = straight(40.0, 5.0), straight(38.0, 3.0)
    if closed:
        outer, inner = capped(*outer), capped(*inner)
    inner = (inner[0] + [0.0, 0.0, 1.0], inner[1][:, ::-1])
    assert "this is a wall, not a lumen" in refused(tmp_path, joined(outer, inner))


# Legs side by side


@pytest.mark.parametrize(("gap", "count"), [(1.5, 1080), (0.2, 1080)])
def test_the_column_stands_in_its_own_leg(gap: float, count: int, tmp_path: Path) -> None:
    _, scene, vessel = made(tmp_path, hairpin(gap), spacing=SPACING)
    opening = vessel.opening(scene.column.opening)
    for column in (scene.column, type(scene.column)(opening=opening.name, particles=500)):
        blood = vessel.fill_column(column, SPACING)
        assert len(blood) == (500 if column.particles else count)
        assert (np.sign(blood[:, 0]) == np.sign(opening.centre[0])).all()


def test_a_gap_thinner_than_the_wall_is_named_and_has_no_hole(tmp_path: Path) -> None:
    _, scene, vessel = made(tmp_path, hairpin(0.2), spacing=SPACING)
    start = initial_state(scene, vessel)
    # Points are never quite opposite: the curved walls are a little farther apart there.
    assert 0.2e-3 <= start.wall.narrowest_gap < 0.35e-3
    (finding,) = check_gaps(start.wall, SPACING, start.setback)
    assert not finding.good
    assert "two parts of the lumen come within 0.2" in finding.text
    # Straight between the legs, above the bend, there is a proxy within a spacing everywhere.
    heights = np.linspace(vessel.bounds[1][2] - 0.03, vessel.bounds[1][2] - 0.002, 50)
    between = np.stack([0 * heights, 0 * heights, heights], axis=1)
    apart = np.linalg.norm(between[:, None] - start.wall.positions[None], axis=2).min(axis=1)
    assert apart.max() < SPACING
    nearest = np.linalg.norm(start.blood[:, None] - start.proxies[None], axis=2).min()
    # Places are of a finer lattice than the blood's, until it settles.
    assert nearest >= 0.35 * SPACING + 0.9 * start.setback


def test_legs_far_apart_have_no_gap(tmp_path: Path) -> None:
    _, scene, vessel = made(tmp_path, hairpin(6.0), spacing=SPACING)
    start = initial_state(scene, vessel)
    assert check_gaps(start.wall, SPACING, start.setback) == []
    assert start.left_out == 0


def test_blood_of_a_leg_that_goes_on_beside_an_opening_has_not_left_by_it(tmp_path: Path) -> None:
    _, _, vessel = made(tmp_path, hairpin(1.5, lower=12.0), spacing=SPACING)
    low = min(range(2), key=lambda k: vessel.openings[k].centre[2])
    opening = vessel.openings[low]
    reach = vessel.clear_beyond(low, 2.5)
    # The other leg's wall is a radius and the gap away; an opening's own rim must be within.
    assert opening.radius < reach < opening.radius + 1.6e-3
    assert vessel.clear_beyond(1 - low, 2.5) == 2.5 * vessel.openings[1 - low].radius


# Sharp rims, gravity


def test_blood_begins_clear_of_proxies_that_a_sharp_rim_presses_inwards(tmp_path: Path) -> None:
    vertices, faces = straight(40.0, 4.0, around=24)
    vertices[:, 2] += np.tan(np.radians(50)) * vertices[:, 0] * vertices[:, 2] / 40.0
    _, scene, vessel = made(tmp_path, (vertices, faces))
    start = initial_state(scene, vessel)
    spacing = scene.discretization.spacing
    apart = np.linalg.norm(start.blood[:, None] - start.proxies[None], axis=2).min()
    assert apart >= 0.35 * spacing + 0.9 * start.setback
    # Beside the rim is less room than the lumen has, and elsewhere as much more blood.
    room = vessel.column_room(scene.column, spacing)
    assert len(start.blood) == round(room.volume / spacing**3)


def test_gravity_points_into_the_columns_opening_and_another_way_is_said(tmp_path: Path) -> None:
    turn = np.linspace(0, 0.75 * np.pi, 12)
    arc = 20.0 * np.stack([np.cos(turn), 0 * turn, np.sin(turn)], axis=1)
    text, scene, vessel = made(tmp_path, swept(arc, 3.0))
    opening = vessel.opening(scene.column.opening)
    assert np.array(scene.gravity) @ opening.normal == pytest.approx(-9.81, rel=1e-3)
    assert "gravity: assumed straight into opening_1" in text
    assert check_gravity(vessel, opening.name, scene.gravity) == []
    aside = np.cross(opening.normal, [0.0, 1.0, 0.0])
    (finding,) = check_gravity(vessel, opening.name, tuple(9.81 * aside))
    assert "90 degrees off the way into opening" in finding.text


# Surfaces straight from voxels


def rod(places: np.ndarray) -> np.ndarray:
    along = np.array([1.0, 0.3, 2.0]) / np.linalg.norm([1.0, 0.3, 2.0])
    apart = places - [5.0, 6.0, 0.0]
    aside = apart - (apart @ along)[..., None] * along
    within = np.linalg.norm(aside, axis=-1) < 3.5
    return within & (places[..., 2] >= 0.0) & (places[..., 2] <= 30.0)


def test_a_stepped_surface_is_told_and_smoothed_when_asked(tmp_path: Path) -> None:
    stepped = from_voxels(rod, np.array([26.0, 14.0, 31.0]), 0.7)
    text = refused(tmp_path, stepped)
    assert "stepped" in text
    assert "--smooth" in text
    text, _, vessel = made(tmp_path, stepped, smooth=True)
    assert "smoothed: " in text
    assert len(vessel.openings) == 2
    # The slanted section's circle of equal area; half a voxel is lost or won at its rim.
    expected = 3.5e-3 * np.sqrt(np.linalg.norm([1.0, 0.3, 2.0]) / 2.0)
    assert [o.radius for o in vessel.openings] == pytest.approx([expected] * 2, abs=0.35e-3)


def test_a_scene_of_ones_own_may_have_caps_that_are_not_flat() -> None:
    tables = {
        "low": OpeningTable(centre=(0.0, 0.0, 0.0)),
        "high": OpeningTable(centre=(0.0, 0.0, 40.0)),
    }
    vertices, faces = domed(0.02, 0.1, 3)
    vessel = build_vessel(1e-3 * vertices, faces, tables, 1e-3, "my.stl")
    assert [o.name for o in vessel.openings] == ["low", "high"]
    for opening, height in zip(vessel.openings, (0.0, 0.04), strict=True):
        assert opening.centre == pytest.approx([0.0, 0.0, height], abs=1e-9)
    vertices, faces = domed(0.0, 0.5, 3)
    with pytest.raises(InputError, match=r"openings\.high: .* it bulges by 51 %"):
        build_vessel(1e-3 * vertices, faces, tables, 1e-3, "my.stl")
