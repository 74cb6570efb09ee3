"""Surfaces generated from tables."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from app.scenes import branching
from app.scenes.centreline import make_surface, remake
from app.scenes.vessel_table import Box, Branch, Centrelines, End, Revolved, Tube, read_shape
from places import VESSELS
from taichi_sph.errors import InputError
from taichi_sph.geometry import mesh
from taichi_sph.geometry.caps import find_caps
from taichi_sph.geometry.mesh import NearestPoint
from taichi_sph.geometry.surface_file import load_surface

NAMES = sorted(path.parent.name for path in VESSELS.glob("*/centreline.json"))
MEASURED = ["aortoiliac", "basilar_bifurcation", "carotid_siphon", "portal_vein"]


def test_the_eight_vessels_are_shipped() -> None:
    assert sorted([*MEASURED, "box", "fda_nozzle", "stenosis", "tube"]) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_shipped_surface_is_one_closed_skin_of_good_triangles(name: str) -> None:
    vertices, faces = load_surface(VESSELS / name / "lumen.ply")
    assert mesh.is_closed(faces)
    assert mesh.is_winding_consistent(faces)
    assert mesh.components(faces)[0] == 1
    assert mesh.genus(faces) == 0
    assert mesh.enclosed_volume(vertices, faces) > 0
    assert len(mesh.self_intersections(vertices, faces)) == 0
    corners = vertices[faces]
    square = ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(axis=(1, 2))
    area = np.linalg.norm(mesh.face_vectors(vertices, faces), axis=1)
    quality = 4 * math.sqrt(3) * area / square  # 1 for an equilateral triangle
    assert quality.min() > 0.15
    if name in MEASURED:
        assert 10_000 < len(faces) < 30_000
        assert np.quantile(quality, 0.01) > 0.5


@pytest.mark.parametrize("name", MEASURED)
def test_openings_lie_where_the_table_says_and_are_flat(name: str) -> None:
    table = json.loads((VESSELS / name / "centreline.json").read_text())
    vertices, faces = load_surface(VESSELS / name / "lumen.ply")
    caps = [faces[cap.faces] for cap in find_caps(vertices, faces, name)]
    assert len(caps) == len(table["openings"])
    for end in table["openings"]:
        centre, radius = np.array(end["centre"]) * 1e-3, end["radius"] * 1e-3
        planes = [mesh.region_plane(vertices, cap) for cap in caps]
        nearest = min(range(len(caps)), key=lambda k: np.linalg.norm(planes[k][0] - centre))
        middle, normal, area = planes[nearest]
        assert np.linalg.norm(middle - centre) < 0.1 * radius
        assert normal @ np.array(end["normal"]) > 0.9999
        assert math.sqrt(area / math.pi) == pytest.approx(radius, rel=0.03)
        height = (vertices[np.unique(caps[nearest])] - centre) @ np.array(end["normal"])
        assert np.ptp(height) < 1e-4 * radius


@pytest.mark.validation
def test_remaking_the_aorta_gives_the_committed_surface(tmp_path: Path) -> None:
    (tmp_path / "centreline.json").write_bytes(
        (VESSELS / "aortoiliac" / "centreline.json").read_bytes()
    )
    triangles, volume = remake(tmp_path)
    made, made_faces = load_surface(tmp_path / "lumen.ply")
    kept, kept_faces = load_surface(VESSELS / "aortoiliac" / "lumen.ply")
    # Another processor may round another way and so turn a triangle: the surface is what counts.
    assert triangles == pytest.approx(len(kept_faces), rel=0.01)
    assert volume == pytest.approx(mesh.enclosed_volume(kept, kept_faces), rel=1e-3)
    for points, other in ((made, (kept, kept_faces)), (kept, (made, made_faces))):
        distance = NearestPoint(*other)(points)[0]
        assert distance.max() < 1e-4  # m
        assert distance.mean() < 5e-6


@pytest.mark.parametrize("name", ["tube", "stenosis", "box", "fda_nozzle"])
def test_plain_shapes_are_what_is_committed(name: str, tmp_path: Path) -> None:
    (tmp_path / "centreline.json").write_bytes((VESSELS / name / "centreline.json").read_bytes())
    remake(tmp_path)
    made, made_faces = load_surface(tmp_path / "lumen.ply")
    kept, kept_faces = load_surface(VESSELS / name / "lumen.ply")
    assert np.array_equal(made_faces, kept_faces)
    assert np.abs(made - kept).max() < 1e-8


def test_tube_has_the_cylinders_volume() -> None:
    vertices, faces = make_surface(Tube(name="t", radius=5, length=60))
    exact = math.pi * 5e-3**2 * 60e-3
    assert mesh.enclosed_volume(vertices, faces) == pytest.approx(exact, rel=1.5e-3)
    finer = make_surface(Tube(name="t", radius=5, length=60, segments=144))
    assert mesh.enclosed_volume(*finer) == pytest.approx(exact, rel=4e-4)


@pytest.mark.parametrize("profile", [[(0, 5), (9, 5), (4, 3)], [(0, 5), (0, 3), (9, 3)]])
def test_a_profile_that_turns_back_or_is_closed_at_an_end_is_named(profile, tmp_path) -> None:
    path = tmp_path / "centreline.json"
    path.write_text(json.dumps({"shape": "revolved", "name": "n", "profile": profile}))
    with pytest.raises(InputError, match="profile: z must rise") as error:
        read_shape(path)
    assert str(path) in str(error.value)


def test_a_revolved_profile_has_the_volume_of_its_cones_and_its_steps() -> None:
    profile = [(-8.0, 6.0), (0.0, 2.0), (5.0, 2.0), (5.0, 6.0), (15.0, 6.0)]
    vertices, faces = make_surface(Revolved(name="n", profile=profile, segments=144))
    cone = math.pi / 3.0 * 8e-3 * (6e-3**2 + 6e-3 * 2e-3 + 2e-3**2)
    exact = cone + math.pi * (5e-3 * 2e-3**2 + 10e-3 * 6e-3**2)
    # 144 chords for a circle enclose 0.03 % less.
    assert mesh.enclosed_volume(vertices, faces) == pytest.approx(exact, rel=1e-3)
    step = vertices[np.abs(vertices[:, 2] - 5e-3) < 1e-9]
    radius = np.hypot(step[:, 0], step[:, 1])
    assert radius.min() == pytest.approx(2e-3)
    assert radius.max() == pytest.approx(6e-3)


@pytest.mark.parametrize("narrowing", [30.0, 50.0, 70.0])
def test_stenosis_has_the_volume_of_its_formula_and_the_throat_of_its_number(
    narrowing: float,
) -> None:
    shape = Tube(name="s", radius=5, length=60, narrowing=narrowing, throat_length=20, segments=144)
    vertices, faces = make_surface(shape)
    s = narrowing / 100
    # Mean of (1 - s (1 + cos) / 2)^2 over a wave is 1 - s + 3 s^2 / 8.
    exact = math.pi * 5e-3**2 * (40e-3 + 20e-3 * (1 - s + 0.375 * s**2))
    assert mesh.enclosed_volume(vertices, faces) == pytest.approx(exact, rel=1e-3)
    middle = vertices[np.abs(vertices[:, 2]) < 1e-6]
    assert np.hypot(middle[:, 0], middle[:, 1]).max() == pytest.approx(5e-3 * (1 - s))


def test_box_has_its_volume() -> None:
    volume = mesh.enclosed_volume(*make_surface(Box(name="b", size=(16, 12, 40))))
    assert volume == pytest.approx(16e-3 * 12e-3 * 40e-3, rel=1e-12)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"radius": -1}, "radius"),
        ({"narowing": 3}, "narowing"),
        ({"narrowing": 100}, "narrowing"),
        ({"shape": "torus"}, "torus"),
        ({"units": "cm"}, "units"),
    ],
)
def test_mistakes_in_a_table_are_named(change: dict, words: str, tmp_path: Path) -> None:
    table = {"shape": "tube", "name": "t", "radius": 5, "length": 60} | change
    path = tmp_path / "centreline.json"
    path.write_text(json.dumps(table))
    with pytest.raises(InputError) as error:
        read_shape(path)
    assert str(path) in str(error.value)
    assert words in str(error.value)


def test_a_branch_that_ends_nowhere_is_named(tmp_path: Path) -> None:
    table = json.loads((VESSELS / "aortoiliac" / "centreline.json").read_text())
    table["branches"][1]["end"] = "elsewhere"
    path = tmp_path / "centreline.json"
    path.write_text(json.dumps(table))
    with pytest.raises(InputError, match=r"elsewhere.*outlet_iliac_A"):
        make_surface(read_shape(path))


def test_crossing_triangles_are_found() -> None:
    vertices, faces = make_surface(Tube(name="t", radius=5, length=20, segments=24))
    assert len(mesh.self_intersections(vertices, faces)) == 0
    spike = int(np.argmax(vertices[:, 0] - np.abs(vertices[:, 2])))
    vertices[spike, 0] = -7e-3
    assert len(mesh.self_intersections(vertices, faces)) > 2


def side_by_side(apart: float) -> Centrelines:
    """A trunk that divides into two parallel branches so far apart [mm]; one goes on farther."""

    def branch(name: str, stations: list[tuple[float, float]], end: str) -> Branch:
        points = [(float(x), 0.0, float(z), 2.0) for x, z in stations]
        return Branch(name=name, points=points, end=end)

    def end(name: str, x: float, z: float, sign: float) -> End:
        return End(name=name, centre=(x, 0.0, z), normal=(0.0, 0.0, sign), radius=2.0)

    x = apart
    return Centrelines(
        name="legs",
        branches=[
            branch("a", [(0, 0), (0, 5), (0, 10), (0, 15), (0, 20)], "top"),
            branch("b", [(0, 2), (2.5, 5), (x, 9), (x, 14), (x, 20), (x, 26), (x, 30)], "high"),
            branch("trunk", [(0, 2), (0, -4), (0, -10)], "low"),
        ],
        openings=[end("top", 0, 20, 1), end("high", x, 30, 1), end("low", 0, -10, -1)],
        smoothing_length=0.1,
    )


@pytest.mark.parametrize("apart", [4.6, 5.5])
def test_a_branch_that_passes_an_opening_is_not_cut_with_it(
    apart: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(branching, "TRIANGLES", 3000)
    vertices, faces = make_surface(side_by_side(apart))
    assert mesh.is_closed(faces)
    assert mesh.genus(faces) == 0
    flat = [cap for cap in find_caps(vertices, faces, "legs") if cap.is_flat]
    heights = sorted(float(cap.centre[2]) for cap in flat)
    assert heights == pytest.approx([-0.01, 0.02, 0.03], abs=1e-6)
    # At 3000 triangles a circle is a polygon of some 20 corners.
    assert [cap.radius for cap in flat] == pytest.approx([2e-3] * 3, rel=0.03)


def test_a_branch_that_grows_into_a_prolonged_end_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(branching, "TRIANGLES", 3000)
    with pytest.raises(InputError, match="'top' cannot be cut off: another branch runs into"):
        make_surface(side_by_side(2.5))
