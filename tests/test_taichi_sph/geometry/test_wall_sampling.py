"""Proxies of the wall: even, set back, stored."""

import math
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh

from meshes import (
    BOTTOM,
    RADIUS,
    pipe,
)
from taichi_sph.geometry import mesh, wall_sampling
from taichi_sph.geometry.vessel import Vessel


@pytest.mark.parametrize("ratio", [1.0, 0.5])
def test_proxies_are_even_set_back_and_of_the_right_number(aorta: Vessel, ratio: float) -> None:
    spacing, setback = 0.9e-3 * ratio, 0.45e-3
    wall = aorta.sample_wall(spacing, setback, seed=3)
    assert len(wall.positions) + wall.dropped == round(aorta.wall_area / spacing**2)
    assert len(wall.positions) == pytest.approx(aorta.wall_area / spacing**2, rel=0.02)
    assert wall.nearest_spread < 0.07
    assert 0.85 < wall.nearest_mean < 1.0
    assert wall.nearest_least > 0.6
    assert wall.largest_gap < 0.95
    assert np.linalg.norm(wall.normals, axis=1) == pytest.approx(1.0)
    distance = aorta.signed_distance(wall.positions)
    assert distance.min() > 0.4 * setback
    assert distance.max() < 1.01 * setback
    assert np.median(distance) == pytest.approx(setback, rel=0.01)
    for opening in aorta.openings:
        apart = wall.positions - opening.centre
        near = np.linalg.norm(apart, axis=1) < 2 * opening.radius
        height = apart[near] @ opening.normal
        # Flush: none beyond the plane, some right at it.
        assert height.max() <= 1e-7
        assert height.max() > -0.5 * spacing


def test_gaps_are_what_an_independent_search_finds(aorta: Vessel) -> None:
    spacing = 1e-3
    points, nearest = wall_sampling.relaxed_points(aorta.vertices, aorta.wall_faces, spacing, 0)
    corners = aorta.vertices[aorta.wall_faces[nearest]]
    normal = mesh.unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    assert np.abs(np.einsum("ij,ij->i", points - corners[:, 0], normal)).max() < 1e-9
    probes, _ = trimesh.sample.sample_surface(
        trimesh.Trimesh(aorta.vertices, aorta.wall_faces, process=False), 40_000, seed=5
    )
    gap = np.sqrt(((probes[:, None] - points[None, ::40]) ** 2).sum(axis=2)).min(axis=1)
    assert gap.max() > 2 * spacing  # every 40th point leaves holes: the measure sees them
    figures = wall_sampling.spacing_statistics(points, aorta.vertices, aorta.wall_faces, spacing)
    thinned = wall_sampling.spacing_statistics(
        points[::2], aorta.vertices, aorta.wall_faces, spacing
    )
    assert thinned[3] > 1.0 > figures[3]


def test_a_capped_opening_carries_proxies_and_an_open_one_does_not() -> None:
    wall = pipe(bottom="capped").sample_wall(1e-3, 0.5e-3)
    on_axis = np.hypot(wall.positions[:, 0], wall.positions[:, 1]) < 0.8 * RADIUS
    assert (wall.positions[on_axis][:, 2] < BOTTOM[2]).all()
    assert on_axis.sum() == pytest.approx(0.64 * math.pi * RADIUS**2 / 1e-6, rel=0.1)


def test_sampling_repeats_to_the_last_bit_and_follows_the_seed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    first = pipe().sample_wall(1e-3, 0.5e-3, seed=1)
    again = pipe().sample_wall(1e-3, 0.5e-3, seed=1)
    other = pipe().sample_wall(1e-3, 0.5e-3, seed=2)
    assert first.positions.tobytes() == again.positions.tobytes()
    assert first.normals.tobytes() == again.normals.tobytes()
    assert not np.array_equal(first.positions, other.positions)


def test_the_cache_gives_the_same_points_and_survives_damage(
    monkeypatch: pytest.MonkeyPatch, own_cache: Path
) -> None:
    monkeypatch.setattr(wall_sampling, "_CACHE_FROM", 0)
    first = pipe().sample_wall(1e-3, 0.5e-3)
    (file,) = own_cache.iterdir()
    calls = []
    real = wall_sampling.relaxed_points

    def counted(*given):
        calls.append(given)
        return real(*given)

    monkeypatch.setattr(wall_sampling, "relaxed_points", counted)
    stored = pipe().sample_wall(1e-3, 0.5e-3)
    assert not calls
    assert stored.positions.tobytes() == first.positions.tobytes()
    assert stored.largest_gap == first.largest_gap
    pipe(bottom="capped").sample_wall(1e-3, 0.5e-3)
    pipe().sample_wall(1e-3, 0.4e-3)
    assert len(calls) == 2  # another wall or setback has another key
    for damage in (b"", file.read_bytes()[:300], b"garbage" * 50):
        calls.clear()
        file.write_bytes(damage)
        again = pipe().sample_wall(1e-3, 0.5e-3)
        assert len(calls) == 1
        assert again.positions.tobytes() == first.positions.tobytes()


def test_a_cache_that_cannot_be_written_is_no_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(wall_sampling, "_CACHE_FROM", 0)
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", os.fspath(blocked))
    assert len(pipe().sample_wall(1e-3, 0.5e-3).positions) > 900
