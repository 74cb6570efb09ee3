"""Vessels: distances, openings, mistakes in files, leaks, the narrowest place."""

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh

from meshes import (
    BOTTOM,
    LENGTH,
    RADIUS,
    TOP,
    cylinder,
    pipe,
    tables,
    write_scene,
)
from places import VESSELS
from taichi_sph.errors import InputError
from taichi_sph.geometry import mesh
from taichi_sph.geometry.findings import check_vessel
from taichi_sph.geometry.interior import Interior
from taichi_sph.geometry.vessel import Vessel, build_vessel, read_vessel
from taichi_sph.scene import Column, OpeningTable, read_scene


def closed_vessel(vertices: np.ndarray, faces: np.ndarray) -> Vessel:
    return Vessel(
        np.asarray(vertices, float), np.asarray(faces, np.int32), np.full(len(faces), -1), ()
    )


# Distances


def test_signed_distance_of_a_sphere() -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.01)
    vessel = closed_vessel(ball.vertices, ball.faces)
    points = np.random.default_rng(0).uniform(-0.015, 0.015, (3000, 3))
    exact = np.linalg.norm(points, axis=1) - 0.01
    # Between vertices the triangles lie below the sphere by a few millionths of a metre.
    assert np.abs(vessel.signed_distance(points) - exact).max() < 6e-6
    clear = np.abs(exact) > 1e-5
    assert np.array_equal(vessel.contains(points)[clear], exact[clear] < 0)
    assert vessel.volume == pytest.approx(4 / 3 * math.pi * 0.01**3, rel=1e-3)


def test_signed_distance_of_a_cylinder() -> None:
    vessel = build_vessel(*cylinder(segments=144), tables(), 1.0, "tube")
    points = np.random.default_rng(1).uniform(-0.02, 0.02, (3000, 3)) * [0.4, 0.4, 1.0]
    radial = np.hypot(points[:, 0], points[:, 1]) - RADIUS
    axial = np.abs(points[:, 2]) - LENGTH / 2
    exact = np.minimum(np.maximum(radial, axial), 0) + np.hypot(
        np.maximum(radial, 0), np.maximum(axial, 0)
    )
    assert np.abs(vessel.signed_distance(points) - exact).max() < 3e-6


def test_boxes_called_inside_are_and_most_of_the_lumen_is_in_such(aorta: Vessel) -> None:
    low, high = aorta.bounds
    interior = Interior(low, high, aorta.volume, aorta.signed_distance)
    random = np.random.default_rng(2)
    for _ in range(2):  # asked for the first time, and known
        points = random.uniform(low - 2e-3, high + 2e-3, (20_000, 3))
        points[:2] = low, high
        held, depth = interior.holds(points), -aorta.signed_distance(points)
        assert depth[held].min() > 0.0
        # A box whose middle is deeper than its half diagonal reaches half a diagonal deeper.
        deep = depth > math.sqrt(3.0) * 1.001 * interior.size
        assert deep.sum() > 100
        assert held[deep].all()
        assert not held[~aorta.contains(points)].any()


# Openings


@pytest.mark.parametrize("capped", [True, False])
def test_openings_of_a_cylinder_are_found(capped: bool) -> None:
    vessel = build_vessel(*cylinder(capped), tables(bottom="capped"), 1.0, "tube")
    assert [o.name for o in vessel.openings] == ["top", "bottom"]
    for opening, centre, direction in zip(vessel.openings, (TOP, BOTTOM), (1, -1), strict=True):
        assert np.abs(opening.centre - centre).max() < 1e-7
        assert opening.normal == pytest.approx([0, 0, direction], abs=1e-6)
        assert opening.radius == pytest.approx(RADIUS, rel=2e-3)
        assert opening.area == pytest.approx(math.pi * opening.radius**2)
    assert [o.is_open for o in vessel.openings] == [True, False]
    assert mesh.is_closed(vessel.faces.astype(np.int64))
    assert vessel.volume == pytest.approx(math.pi * RADIUS**2 * LENGTH, rel=4e-3)
    top = vessel.vertices[vessel.faces[vessel.face_opening == 0]]
    assert np.abs(top[:, :, 2] - TOP[2]).max() < 1e-7
    # The open cap carries no proxies, the capped one does.
    walls = 2 * math.pi * RADIUS * LENGTH + math.pi * RADIUS**2
    assert vessel.wall_area == pytest.approx(walls, rel=2e-3)
    assert vessel.unnamed == ()


def test_an_uneven_rim_is_carried_on_to_a_flat_cap() -> None:
    vertices, faces = cylinder(capped=False)
    rim = vertices[:, 2] > TOP[2] - 1e-9
    vertices[rim, 2] += 4e-4 * np.sin(3 * np.arctan2(vertices[rim, 1], vertices[rim, 0]))
    vessel = build_vessel(vertices, faces, tables(), 1.0, "tube")
    cap = vessel.faces[vessel.face_opening == 0]
    height = vessel.vertices[np.unique(cap)] @ vessel.openings[0].normal
    assert np.ptp(height) < 1e-9
    assert TOP[2] + 4e-4 < height.mean() < TOP[2] + 8e-4
    assert len(mesh.self_intersections(vessel.vertices, vessel.faces.astype(int))) == 0


def test_an_opening_that_the_scene_does_not_name_is_capped() -> None:
    for capped in (True, False):
        vessel = build_vessel(*cylinder(capped), {"top": tables()["top"]}, 1.0, "tube")
        assert [o.is_open for o in vessel.unnamed] == [False]
        assert np.abs(vessel.unnamed[0].centre - BOTTOM).max() < 1e-7
        assert vessel.wall_area > 2 * math.pi * RADIUS * LENGTH + 0.9 * math.pi * RADIUS**2
        assert any("not named" in f.text and not f.good for f in check_vessel(vessel))


def test_centres_are_in_units_of_the_file() -> None:
    vertices, faces = cylinder()
    vessel = build_vessel(vertices, faces, tables(scale=1e-3), 1e-3, "tube")
    assert np.abs(vessel.openings[0].centre - TOP).max() < 1e-7


def test_a_size_that_no_vessel_has_is_a_finding() -> None:
    vertices, faces = cylinder()
    for larger, told in ((1.0, False), (7.0, False), (20.0, True)):
        openings = {"top": OpeningTable(centre=(0.0, 0.0, TOP[2] * larger))}
        vessel = build_vessel(vertices * larger, faces, openings, 1.0, "tube")
        lines = [f.text for f in check_vessel(vessel) if not f.good]
        assert ("no vessel is so large; is vessel.scale right?" in lines) is told


def test_an_oblique_end_is_an_opening() -> None:
    vertices, faces = cylinder()
    vertices[:, 2] += 0.5 * vertices[:, 0]
    vessel = build_vessel(vertices, faces, tables(), 1.0, "tube")
    assert vessel.openings[0].normal == pytest.approx(np.array([-0.5, 0, 1]) / math.sqrt(1.25))


# Mistakes in files


def no_change(vertices, faces):
    return vertices, faces


def with_nan(vertices, faces):
    vertices[7] = np.nan
    return vertices, faces


def inside_out(vertices, faces):
    return vertices, faces[:, ::-1]


def one_turned(vertices, faces):
    faces[10] = faces[10][::-1]
    return vertices, faces


def with_hole(vertices, faces):
    side = np.flatnonzero(np.ptp(vertices[faces][:, :, 2], axis=1) > 1e-9)
    return vertices, np.delete(faces, side[200], axis=0)


def with_large_hole(vertices, faces):
    middle = vertices[faces].mean(axis=1)
    return vertices, faces[np.linalg.norm(middle - [RADIUS, 0, 0], axis=1) > 2e-3]


def with_fin(vertices, faces):
    return (
        np.concatenate([vertices, [[0.02, 0.0, 0.0]]]),
        np.concatenate([faces, [[*faces[5, :2], len(vertices)]]]),
    )


def two_pieces(vertices, faces):
    return (
        np.concatenate([vertices, vertices + np.array([0.03, 0, 0])]),
        np.concatenate([faces, faces + len(vertices)]),
    )


def pinched(vertices, faces):
    # Two tubes that share the middle of a cap's vertex.
    other = vertices + np.array([0, 0, LENGTH])
    top = int(np.argmin(np.linalg.norm(vertices - TOP, axis=1)))
    low = int(np.argmin(np.linalg.norm(other - vertices[top], axis=1)))
    other[:, 2] += 0.01 * (np.arange(len(other)) != low)
    other[low] = vertices[top]
    return np.concatenate([vertices, other]), np.concatenate([faces, faces + len(vertices)])


def in_millimetres(vertices, faces):
    return vertices * 1e3, faces


def in_kilometres(vertices, faces):
    return vertices * 1e-3, faces


def no_faces(vertices, faces):
    return vertices, faces[:0]


def flat(vertices, faces):
    sheet = vertices * [1, 1, 0]
    return sheet + 1e-13 * vertices, faces


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (with_nan, ["1 of", "not finite", "all must be finite"]),
        (inside_out, ["normals point inwards", "turn"]),
        (one_turned, ["turn different ways", "outward"]),
        (with_hole, ["hole", "3 edges", "close it"]),
        (with_large_hole, ["hole", "the wall lies in its plane", "close it"]),
        (with_fin, ["more than two triangles", "one or two"]),
        (two_pieces, ["2 separate pieces", "one connected"]),
        (pinched, ["touch at a single vertex", "separate or merge"]),
        (in_millimetres, ["30 m across", "millimetres", "vessel.scale = 0.001"]),
        (in_kilometres, ["3e-05 m across", "vessel.scale = 1000"]),
        (no_faces, ["no triangles", "tube is needed"]),
    ],
)
def test_a_bad_surface_is_refused_in_one_sentence(change, words, tmp_path: Path) -> None:
    scene = write_scene(tmp_path, change(*cylinder()))
    with pytest.raises(InputError) as error:
        read_vessel(scene)
    message = str(error.value)
    assert str(tmp_path / "lumen.ply") in message
    assert "\n" not in message
    for word in words:
        assert word in message


def test_a_good_surface_is_not_refused(tmp_path: Path) -> None:
    assert read_vessel(write_scene(tmp_path, no_change(*cylinder()))).volume > 0


@pytest.mark.parametrize(
    "content",
    [b"", b"not a mesh at all", b"ply\nformat ascii 1.0\nelement vertex 3\n", b"\x00" * 99],
)
def test_bytes_that_are_no_mesh_are_refused(content: bytes, tmp_path: Path) -> None:
    scene = write_scene(tmp_path, content)
    with pytest.raises(InputError, match=r"lumen\.ply: (not a readable|the surface has no)"):
        read_vessel(scene)


def test_a_missing_surface_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"lumen\.ply: cannot read the surface: No such file"):
        read_vessel(write_scene(tmp_path, None))


def test_a_wrong_or_doubled_opening_is_named(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, cylinder(), {"top": TOP, "side": (0.02, 0.0, 0.0)})
    with pytest.raises(InputError, match=r"openings\.side: no opening of .* is at \(0\.02, 0, 0\)"):
        read_vessel(scene)
    scene = write_scene(tmp_path, cylinder(), {"top": TOP, "again": (0.001, 0.0, TOP[2])})
    with pytest.raises(InputError, match=r"openings\.again: the same opening .* openings\.top"):
        read_vessel(scene)


def test_a_column_at_an_opening_that_is_not_there_is_refused(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, cylinder(), {}, 'opening = "top"\nheight = 0.01')
    with pytest.raises(InputError, match=r"column\.opening: 'top' is not an opening; allowed:"):
        read_vessel(scene)


def test_a_spacing_too_coarse_is_refused_with_one_that_is_not(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"spacing: 0\.003 m puts 3\.3 .* at most 0\.00249 m"):
        read_vessel(write_scene(tmp_path, cylinder(), spacing=3e-3))
    assert read_vessel(write_scene(tmp_path, cylinder(), spacing=2.4e-3)).volume > 0


@pytest.mark.parametrize(
    ("column", "words"),
    [
        (Column(opening="top", height=0.05), ["column.height: 0.05 m", "at most 0.03 m fits"]),
        (Column(opening="top", height=0.02, offset=0.015), ["column.height", "0.015 m fits"]),
        (Column(opening="top", height=0.01, offset=0.04), ["column.offset", "0.03 m"]),
        (Column(opening="top", height=0.0003), ["column.height: 0.0003 m", "less than one layer"]),
        (Column(opening="top", particles=9999), ["column.particles: 9999 do not fit", "fit"]),
        (Column(opening="side", height=0.01), ["'side' is not an opening", "top, bottom"]),
    ],
)
def test_a_column_that_does_not_fit_is_refused(column: Column, words: list[str]) -> None:
    with pytest.raises(InputError) as error:
        pipe().fill_column(column, 1e-3)
    for word in words:
        assert word in str(error.value)


# Leaks


def test_leaks_are_counted_against_the_mesh() -> None:
    vessel = pipe(bottom="capped")
    outside = np.array(
        [
            [0.0, 0.0, 0.0],  # within
            [RADIUS + 1e-4, 0.0, 0.0],  # through the wall
            [0.0, 0.0, TOP[2] + 1e-3],  # out of the open end
            [0.0, 0.0, BOTTOM[2] - 1e-3],  # through the cap
            [RADIUS + 1e-4, 0.0, TOP[2] - 1e-3],  # beside the open end, not beyond it
            [0.0, 0.0, TOP[2] + 1.0],  # far beyond: nobody can say how it came there
        ]
    )
    assert [vessel.count_leaks(point[None]) for point in outside] == [0, 1, 0, 1, 1, 1]
    assert vessel.count_leaks(outside) == 4
    assert vessel.count_leaks(outside, tolerance=2e-4) == 2
    assert vessel.count_leaks(np.zeros((0, 3))) == 0


# Narrowest place


def test_the_narrowest_place_is_the_throat_and_not_a_blind_end(aorta: Vessel) -> None:
    stenosis = read_vessel(read_scene(VESSELS / "stenosis" / "scene.toml"))
    assert stenosis.narrowest == pytest.approx(5e-3, rel=0.02)
    assert pipe().narrowest == pytest.approx(2 * RADIUS, rel=0.01)
    # The stubs of the basilar artery end at 0.7 mm; its way through is wider.
    basilar = read_vessel(read_scene(VESSELS / "basilar_bifurcation" / "scene.toml"))
    assert 1.5e-3 < basilar.narrowest < 2 * min(o.radius for o in basilar.openings)
    assert aorta.narrowest == pytest.approx(2 * 4.2e-3, rel=0.05)


def test_the_check_names_triangles_that_cross() -> None:
    vertices, faces = cylinder()
    vertices[np.argmax(vertices[:, 0] - np.abs(vertices[:, 2])), 0] = -7e-3
    findings = check_vessel(build_vessel(vertices, faces, tables(), 1.0, "tube"))
    assert [f.good for f in findings if "cut through" in f.text] == [False]
