"""Triangle meshes as arrays: topology, volumes, crossings, and what is logged of large ones."""

import logging
from pathlib import Path

import numpy as np
import pytest
import trimesh

import app.cli
from app.scenes.new_scene import create_scene
from surface_bytes import VOLUME, binary_stl, tube
from taichi_sph.geometry import mesh
from taichi_sph.geometry.closed_surface import ClosedSurface

V, F = tube()


def test_volume_is_signed_and_the_same_far_away() -> None:
    assert mesh.enclosed_volume(V, F) == pytest.approx(VOLUME, rel=1e-12)
    assert mesh.enclosed_volume(V, F[:, ::-1]) == pytest.approx(-VOLUME, rel=1e-12)
    # At 1e6, a double has a grain of 1e-10.
    assert mesh.enclosed_volume(V + 1e6, F) == pytest.approx(VOLUME, rel=1e-9)


def test_handles_and_pieces() -> None:
    ring = trimesh.creation.torus(3.0, 1.0, major_sections=12, minor_sections=8)
    assert mesh.genus(F) == 0
    assert mesh.genus(np.asarray(ring.faces)) == 1
    count, piece = mesh.components(np.concatenate([F, F + len(V), F[:5] + 2 * len(V)]))
    assert count == 3
    assert np.bincount(piece).tolist() == [168, 168, 5]
    # A vertex in common makes one piece.
    assert mesh.components(np.array([[0, 1, 2], [2, 3, 4], [5, 6, 7]]))[0] == 2


def test_what_no_triangle_uses_goes_in_the_order_of_the_file() -> None:
    vertices, faces = mesh.drop_unused(V, F[100:])
    used = np.unique(F[100:])
    assert np.array_equal(vertices, V[used])
    assert np.array_equal(used[faces], F[100:])
    assert mesh.drop_unused(V, F[:0])[0].shape == (0, 3)


def test_one_turned_triangle_is_seen() -> None:
    assert mesh.is_winding_consistent(F)
    turned = F.copy()
    turned[7] = turned[7, ::-1]
    assert not mesh.is_winding_consistent(turned)


def crossing_edges(vertices: np.ndarray, faces: np.ndarray) -> set[int]:
    """Triangles of which one's edge pierces another, pair by pair, from the definition."""
    bad = set()
    for i, p in enumerate(faces.tolist()):
        for j, q in enumerate(faces.tolist()):
            for a, b in ((p[0], p[1]), (p[1], p[2]), (p[2], p[0])):
                if i == j or {a, b} & set(q):
                    continue
                sides = vertices[q[:1]] - vertices[q[1:]]
                basis = np.stack([vertices[b] - vertices[a], *sides], axis=1)
                try:
                    t, u, v = np.linalg.solve(basis, vertices[q[0]] - vertices[a])
                except np.linalg.LinAlgError:
                    continue
                if 0 < t < 1 and u > 0 and v > 0 and u + v < 1:
                    bad |= {i, j}
    return bad


def test_crossings_are_those_of_the_definition(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(0)
    vertices = random.uniform(0, 1, (60, 3))
    # Triangles of neighbours, and a few large ones, so that there are several size classes.
    apart = np.linalg.norm(vertices[:, None] - vertices, axis=2)
    large = random.permutation(60)[:30].reshape(10, 3)
    faces = np.concatenate([np.argsort(apart, axis=1)[:, :3], large])
    wanted = crossing_edges(vertices, faces)
    assert 20 < len(wanted) < 70
    for at_once in (20_000, 7):
        monkeypatch.setattr(mesh, "AT_ONCE", at_once)
        assert set(mesh.self_intersections(vertices, faces).tolist()) == wanted


def test_a_closed_surface_knows_inside_and_distance() -> None:
    box = trimesh.creation.box((2.0, 4.0, 6.0))
    surface = ClosedSurface(box.vertices, box.faces)
    points = np.random.default_rng(0).uniform(-4, 4, (500, 3))
    beyond = np.abs(points) - [1.0, 2.0, 3.0]
    exact = np.minimum(beyond.max(axis=1), 0) + np.linalg.norm(np.maximum(beyond, 0), axis=1)
    assert np.abs(surface.signed_distance(points) - exact).max() < 1e-12
    assert np.array_equal(surface.contains(points), exact < 0)
    away, triangle, place = surface.nearest(points)
    assert np.abs(np.linalg.norm(points - place, axis=1) - away).max() < 1e-12
    assert triangle.max() < 12
    assert surface.contains(points[:0]).shape == (0,)


def test_stages_of_large_surfaces_are_shown_and_of_small_ones_not(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    log = logging.getLogger("taichi_sph")
    monkeypatch.setattr(log, "handlers", [app.cli.Stages()])
    monkeypatch.setattr(log, "propagate", False)
    caplog.set_level(logging.INFO, "taichi_sph")
    path = tmp_path / "my[1].stl"
    path.write_bytes(binary_stl(V, F))
    create_scene(path, tmp_path / "small")
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(mesh, "LARGE", 100)
    create_scene(path, tmp_path / "large")
    shown = capsys.readouterr().err.splitlines()
    assert shown[0] == "reading my[1].stl, 0 MB"
    assert "joining corners of 168 triangles" in shown
    assert "looking for triangles that cut others" in shown
