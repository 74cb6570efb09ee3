"""Mending of surfaces: joints, doubles, slivers and loose pieces."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from app.scenes.new_scene import create_scene
from meshes import cylinder, write_scene
from surface_bytes import VOLUME, Mesh, ascii_stl, binary_stl, tube
from taichi_sph.errors import InputError
from taichi_sph.geometry import mesh
from taichi_sph.geometry.findings import check_vessel
from taichi_sph.geometry.mending import largest_piece, mend
from taichi_sph.geometry.surface_file import load_surface, require_manifold
from taichi_sph.geometry.vessel import read_vessel

V, F = tube()
SIZE = 40.0
SCANNER = np.array([120.3, -180.7, 950.2])
"""Where a scanner's patient lies, in mm."""


def soup(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """Every triangle with corners of its own, as STL has them."""
    return vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)


def shaken(by: float) -> Mesh:
    vertices, faces = soup(V, F)
    return vertices + np.random.default_rng(0).uniform(-by, by, vertices.shape), faces


def rounded(digits: int, higher: float = 0.0) -> Mesh:
    """Wall and caps by two programs, one of which writes so many digits."""
    place = V + SCANNER + [0, 0, higher]
    caps = np.array([[float(f"{x:.{digits}g}") for x in v] for v in place])
    return np.concatenate([place, caps]), np.concatenate([F[:144], F[144:] + len(V)])


def one_float_apart() -> Mesh:
    vertices, faces = soup(V + SCANNER, F)
    vertices = vertices.astype(np.float32)
    vertices[::2] = np.nextafter(vertices[::2], np.float32(1e9))
    return vertices.astype(float), faces


def with_faces(*more: list[int]) -> Mesh:
    return V, np.concatenate([F, np.array(more)])


def with_sliver(lift: float) -> Mesh:
    """A triangle on an edge of another, its third corner the middle of the edge."""
    a, b = F[50][:2]
    middle = 0.5 * (V[a] + V[b]) + [0, 0, lift]
    return np.vstack([V, middle]), np.vstack([F, [a, b, len(V)]])


def with_slivers_in_a_row() -> Mesh:
    a, b = F[50][:2]
    places = [V[a] + part * (V[b] - V[a]) for part in (0.25, 0.5, 0.75)]
    n = len(V)
    return np.vstack([V, places]), np.vstack([F, [a, b, n + 1], [a, n + 1, n], [n + 1, b, n + 2]])


def with_needle() -> Mesh:
    """A vertex of the wall split in two, a hair apart, with two needles between."""
    at = 40
    around = np.flatnonzero(np.equal(F, at).any(axis=1))
    half = [k for k in around if V[F[k]][:, 2].mean() > V[at][2]]
    faces = F.copy()
    faces[half] = np.where(faces[half] == at, len(V), faces[half])
    # The two neighbours on the ring, at which the halves meet.
    left, right = at - 1, at + 1
    faces = np.vstack([faces, [left, at, len(V)], [at, right, len(V)]])
    return np.vstack([V, V[at] + [0, 0, 1e-7]]), faces


def with_corner_on_edge() -> Mesh:
    """The lower cap's rim with a vertex in the middle of each side, which the wall lacks."""
    ring = list(range(12))
    middles = np.array([0.5 * (V[j] + V[(j + 1) % 12]) for j in ring])
    faces = [f for f in F.tolist() if V[f][:, 2].max() > 0]
    centre, n = 84, len(V)
    for j in ring:
        faces += [[centre, n + j, j], [centre, (j + 1) % 12, n + j]]
    return np.vstack([V, middles]), np.array(faces)


@pytest.mark.parametrize(
    ("make", "triangles", "words"),
    [
        (lambda: (V, F), 168, ""),
        (lambda: soup(V, F), 168, ""),
        (one_float_apart, 168, "joined"),
        (lambda: shaken(1e-5 * SIZE / 4), 168, "joined"),
        (lambda: rounded(6), 168, "joined: 16 corners"),
        (lambda: rounded(7), 168, "joined"),
        (lambda: rounded(6, 500.0), 168, "joined"),
        (lambda: with_faces(*F[40:45].tolist()), 168, "left out: 5 triangles given twice"),
        (lambda: with_faces(*F[40:45, ::-1].tolist()), 168, "left out: 5 triangles given twice"),
        (lambda: with_faces(*F[40:45, [1, 2, 0]].tolist()), 168, "5 triangles given twice"),
        (lambda: with_faces(*F.tolist()), 168, "left out: 168 triangles given twice"),
        (lambda: with_faces(*F[:, ::-1].tolist()), 168, "168 triangles given twice"),
        (lambda: with_faces(*F.tolist(), *F.tolist()), 168, "336 triangles given twice"),
        (lambda: with_faces([1, 1, 2], [3, 4, 3]), 168, "left out: 2 triangles without area"),
        (lambda: with_sliver(0.0), 168, "left out: 1 triangle without area"),
        (lambda: with_sliver(1e-6), 168, "left out: 1 triangle without area"),
        (with_slivers_in_a_row, 168, "left out: 3 triangles without area"),
        (with_needle, 168, "left out: 2 triangles without area"),
        (with_corner_on_edge, 192, "divided: 12 edges"),
    ],
)
def test_what_others_leave_behind_is_mended_and_said(
    make: Callable[[], Mesh], triangles: int, words: str
) -> None:
    vertices, faces, notes = mend(*make(), "my.stl")
    assert len(faces) == triangles
    assert mesh.is_closed(faces)
    assert mesh.is_winding_consistent(faces)
    require_manifold(vertices, faces, "my.stl")
    # What was joined moved by 0.005 of 40 at most, at the ends.
    assert mesh.enclosed_volume(vertices, faces) == pytest.approx(VOLUME, rel=2e-4)
    assert words in "; ".join(notes)
    assert bool(notes) is bool(words)


def test_a_sound_surface_keeps_its_bits() -> None:
    for vertices, faces in (cylinder(), cylinder(capped=False)):
        mended, same, notes = mend(vertices, faces, "my.ply")
        assert mended.tobytes() == vertices.tobytes()
        assert same.tobytes() == faces.tobytes()
        assert notes == []


def test_a_fine_rim_keeps_its_corners() -> None:
    # Edges of 6e-5 of the surface's size stand nearer than patches may be apart, but a tenth of
    # them is the limit.
    around = 60_000
    angle = 2 * np.pi * np.arange(around) / around
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    vertices = np.concatenate([ring, ring + [0, 0, 1.0]])
    j, k = np.arange(around), (np.arange(around) + 1) % around
    faces = np.concatenate(
        [np.stack([j, k, k + around], 1), np.stack([j, k + around, j + around], 1)]
    )
    mended, same, notes = mend(vertices, faces, "my.stl")
    assert mended.tobytes() == vertices.tobytes()
    assert len(same) == 2 * around
    assert notes == []


def test_a_doubled_wall_within_a_closed_surface_goes() -> None:
    # A double pyramid over a triangle, which is there twice and closes nothing.
    ring = np.array([[1, 0, 0], [-0.5, 0.9, 0], [-0.5, -0.9, 0], [0, 0, 1], [0, 0, -1.0]])
    skin = [f for k in range(3) for f in ([k, (k + 1) % 3, 3], [(k + 1) % 3, k, 4])]
    _, faces, notes = mend(ring, np.array([*skin, [0, 1, 2], [2, 1, 0]]), "my.stl")
    assert np.array_equal(faces, skin)
    assert notes == ["left out: 2 triangles given twice"]


def test_a_sliver_that_closes_the_surface_stays() -> None:
    a, b = F[50][:2]
    across = next(k for k, f in enumerate(F.tolist()) if b in f and a in f and k != 50)
    other = next(v for v in F[across] if v not in (a, b))
    n = len(V)
    halves = [[other, n, a], [other, b, n], [b, a, n]]
    faces = np.vstack([np.delete(F, across, axis=0), halves])
    _, same, notes = mend(np.vstack([V, 0.5 * (V[a] + V[b])]), faces, "my.stl")
    assert mesh.is_closed(same) and len(same) == 170
    assert notes == []


@pytest.mark.parametrize("digits", [3, 4])
def test_patches_too_far_apart_are_refused_with_the_gap(digits: int) -> None:
    vertices, faces, _ = mend(*rounded(digits), "my.stl")
    # Half a unit of the last digit before the point and behind, along three axes.
    with pytest.raises(InputError, match=r"corners on open edges lie within 0.*weld them"):
        require_manifold(vertices, faces, "my.stl")


def test_loose_pieces_are_left_out() -> None:
    small = V * 1e-3 + [3000.0, 0, 0]
    vertices, faces = np.concatenate([V, small]), np.concatenate([F, F + len(V)])
    vertices, faces, notes = mend(vertices, faces, "my.stl")
    vertices, faces, left = largest_piece(vertices, faces, "my.stl")
    assert len(faces) == 168
    assert notes == []
    assert "1 small loose piece, 0.0001 %" in left[0]
    with pytest.raises(InputError, match="2 separate pieces, the largest with 50 %"):
        largest_piece(np.concatenate([V, V + 90]), np.concatenate([F, F + len(V)]), "my.stl")


def test_a_surface_of_lines_is_refused() -> None:
    for vertices in (V * [0, 0, 1], V * 0, V[:1]):
        faces = F if len(vertices) > 1 else np.zeros((0, 3), int)
        with pytest.raises(InputError, match=r"my\.stl: all triangles have collapsed"):
            mend(vertices, faces, "my.stl")


# In scenes


def test_new_and_info_say_what_was_mended(tmp_path: Path) -> None:
    path = tmp_path / "my.stl"
    fine, coarse = tube()[0] + SCANNER, F
    path.write_text(
        ascii_stl(fine, coarse[:144], "wall", "%.9g")
        + ascii_stl(fine, coarse[144:], "caps", "%.6g")
    )
    text = create_scene(path, tmp_path / "patches")
    assert "joined: 16 corners" in text
    assert text.count("radius 3.91 mm") == 2
    path.write_bytes(binary_stl(V, np.vstack([F, F[40:45]])))
    assert "5 triangles given twice" in create_scene(path, tmp_path / "doubled")
    assert "168 triangles, closed" in create_scene(path, tmp_path / "again")
    # A scene of one's own names the surface as it is.
    vertices, faces = cylinder()
    scene = write_scene(tmp_path, (vertices, np.vstack([faces, faces[40:45]])))
    vessel = read_vessel(scene)
    assert len(vessel.faces) == len(faces)
    assert any("5 triangles given twice" in f.text and f.good for f in check_vessel(vessel))


def test_places_in_refusals_are_in_units_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "my.stl"
    # A wall across the lumen at half its length.
    ring = np.arange(36, 48)
    wall = np.stack([np.full(12, len(V)), np.roll(ring, -1), ring], axis=1)
    path.write_bytes(binary_stl(np.vstack([V, [0, 0, 20.0]]) + [100, 0, 0], np.vstack([F, wall])))
    with pytest.raises(InputError) as error:
        create_scene(path, tmp_path / "out")
    text = str(error.value)
    assert "12 edges have more than two triangles (first at (1" in text
    assert "20), in units of the file" in text
    assert load_surface(path)[1].shape == (180, 3)
