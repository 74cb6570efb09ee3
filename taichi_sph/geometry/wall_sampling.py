"""Even points on a triangle mesh: where the wall's proxy particles stand.

Points start one to each equal patch of area and repel each other on the surface.  libigl's
blue_noise gives the same evenness in six times the time and cannot be repeated.
"""

import contextlib
import hashlib
import os
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from taichi_sph.geometry.mesh import (
    Floats,
    Integers,
    NearestPoint,
    corner_normals,
    face_vectors,
)
from taichi_sph.system import replaced

ALGORITHM = 2
"""Change it when the points change: it is part of the cache's key."""
_ROUNDS = 12
_REACH = 2.0
_GAIN = 0.6
_CACHE_FROM = 20_000


@dataclass(frozen=True, eq=False)
class WallSample:
    """Proxy particles of a wall."""

    positions: Floats
    """Set back from the lumen [m], (m, 3)."""
    normals: Floats
    """Unit normals out of the lumen, (m, 3)."""
    nearest_mean: float
    """Mean distance to the nearest other point on the surface, over the spacing asked for [-]."""
    nearest_spread: float
    """Standard deviation of that distance over its mean [-]."""
    nearest_least: float
    """Smallest such distance over the spacing [-]."""
    largest_gap: float
    """Largest distance from a place on the wall to its nearest point, over the spacing [-]."""
    dropped: int
    """Points left out because setting them back put them into or against another branch."""
    narrowest_gap: float
    """Least width of a gap between parts of the lumen side by side [m]; infinite without one."""
    gap_place: tuple[float, float, float]
    """Where it is [m]."""


def _spread_bits(x: Integers) -> Integers:
    """Ten bits, two zeros put between each and the next."""
    x = (x | (x << 16)) & 0x030000FF
    x = (x | (x << 8)) & 0x0300F00F
    x = (x | (x << 4)) & 0x030C30C3
    return (x | (x << 2)) & 0x09249249


def stratified_points(vertices: Floats, faces: Integers, count: int, seed: int) -> Floats:
    """Random points (count, 3), one in each of `count` compact patches of equal area."""
    corners = vertices[faces]
    area = np.linalg.norm(face_vectors(vertices, faces), axis=1)
    # Large triangles are quartered: a patch is a run of triangles, so they must be small.
    while (large := area > 0.5 * area.sum() / count).any():
        a, b, c = (corners[large, k] for k in range(3))
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        corners = np.concatenate([corners[~large], *(np.stack(q, axis=1) for q in quarters)])
        area = np.concatenate([area[~large], np.tile(area[large] / 4, 4)])
    centre = corners.mean(axis=1)
    low = centre.min(axis=0)
    cell = ((centre - low) / max(float(np.ptp(centre, axis=0).max()), 1e-300) * 1023).astype(int)
    # Along Morton's curve, neighbours in the list are neighbours in space.
    curve = sum(_spread_bits(cell[:, axis]) << axis for axis in range(3))
    order = np.argsort(curve, kind="stable")
    corners, total = corners[order], np.cumsum(area[order])
    random = np.random.default_rng(seed)
    place = (np.arange(count) + random.random(count)) / count * total[-1]
    triangle = corners[np.minimum(np.searchsorted(total, place), len(total) - 1)]
    u, v = random.random((2, count, 1))
    u = np.sqrt(u)
    return triangle[:, 0] * (1 - u) + triangle[:, 1] * u * (1 - v) + triangle[:, 2] * u * v


def relaxed_points(
    vertices: Floats, faces: Integers, spacing: float, seed: int
) -> tuple[Floats, Integers]:
    """Points (k, 3) spread evenly on a mesh, area / spacing^2 of them, and their triangles (k,)."""
    area = float(np.linalg.norm(face_vectors(vertices, faces), axis=1).sum())
    count = max(1, round(area / spacing**2))
    points = stratified_points(vertices, faces, count, seed)
    reach = _REACH * spacing
    nearest_on = NearestPoint(vertices, faces)
    nearest = np.zeros(count, np.int64)
    for _ in range(_ROUNDS):
        i, j = cKDTree(points).query_pairs(reach, output_type="ndarray").T
        apart = points[i] - points[j]
        distance = np.maximum(np.linalg.norm(apart, axis=1), 1e-9 * spacing)
        push = apart * ((1.0 - distance / reach) ** 2 / distance)[:, None]
        step = np.empty_like(points)
        for axis in range(3):
            step[:, axis] = np.bincount(i, push[:, axis], count)
            step[:, axis] -= np.bincount(j, push[:, axis], count)
        step *= _GAIN * spacing
        length = np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-300)
        points = points + step * np.minimum(1.0, 0.3 * spacing / length)
        _, nearest, points = nearest_on(points)
    return points, nearest


def normals_at(vertices: Floats, faces: Integers, points: Floats, nearest: Integers) -> Floats:
    """Unit normals (k, 3) at points on triangles `nearest`, smooth except over sharp edges."""
    a, b, c = (vertices[faces[nearest, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    square = np.maximum(np.einsum("ij,ij->i", face, face), 1e-300)
    share = np.stack(
        [
            np.einsum("ij,ij->i", np.cross(c - b, points - b), face) / square,
            np.einsum("ij,ij->i", np.cross(a - c, points - c), face) / square,
            np.einsum("ij,ij->i", np.cross(b - a, points - a), face) / square,
        ],
        axis=1,
    )
    corner = corner_normals(vertices, faces)[nearest]
    normals = np.einsum("kc,kcx->kx", np.clip(share, 0.0, 1.0), corner)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(
        length > 0.1, normals / np.maximum(length, 0.1), face / np.sqrt(square)[:, None]
    )


def spacing_statistics(
    points: Floats, vertices: Floats, faces: Integers, spacing: float
) -> tuple[float, float, float, float]:
    """Mean, relative spread and least of nearest distances, and the largest gap, over spacing."""
    tree = cKDTree(points)
    if len(points) < 2:
        return 0.0, 0.0, 0.0, float("inf")
    nearest = tree.query(points, k=2, workers=-1)[0][:, 1] / spacing
    probes = stratified_points(vertices, faces, 4 * len(points), seed=1)
    gap = float(tree.query(probes, workers=-1)[0].max()) / spacing
    mean = float(nearest.mean())
    return mean, float(nearest.std()) / mean, float(nearest.min()), gap


def cache_key(vertices: Floats, faces: Integers, *numbers: float) -> str:
    """Hash of a surface and of the numbers that its points follow from."""
    text = hashlib.sha256()
    text.update(np.ascontiguousarray(vertices, "<f8").tobytes())
    text.update(np.ascontiguousarray(faces, "<i8").tobytes())
    text.update(repr((ALGORITHM, *numbers)).encode())
    return text.hexdigest()[:40]


def cache_file(kind: str, key: str) -> Path:
    """Where a kind of thing is kept that is computed once, by the hash of what it follows from."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(base) / "vesselflow" / f"{kind}-{key}.npz"


def load_cached(key: str) -> WallSample | None:
    """The points stored under a key; None where there are none or the file is damaged."""
    try:
        with cache_file("wall", key).open("rb") as file, np.load(file, allow_pickle=False) as data:
            positions, normals = data["positions"], data["normals"]
            mean, spread, least, gap, dropped, narrow, x, y, z = map(float, data["figures"])
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    whole = positions.shape == normals.shape and positions.ndim == 2 and positions.shape[1] == 3
    if not whole or not (np.isfinite(positions).all() and np.isfinite(normals).all()):
        return None
    figures = (mean, spread, least, gap, int(dropped), narrow, (x, y, z))
    return WallSample(positions, normals, *figures)


def store_cached(key: str, sample: WallSample) -> None:
    """Keep points for the next start; a cache that cannot be written is no error."""
    if len(sample.positions) < _CACHE_FROM:
        return
    figures = (
        sample.nearest_mean,
        sample.nearest_spread,
        sample.nearest_least,
        sample.largest_gap,
        sample.dropped,
        sample.narrowest_gap,
        *sample.gap_place,
    )
    path = cache_file("wall", key)
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replaced(path) as file:
            np.savez(
                file,
                positions=sample.positions,
                normals=sample.normals,
                figures=np.array(figures),
            )
