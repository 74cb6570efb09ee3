"""Surfaces as people have them: caps that bulge, thin branches, walls as solids, legs, voxels."""

from collections.abc import Callable
from pathlib import Path

import igl
import numpy as np

from surface_bytes import binary_stl
from taichi_sph.geometry import mesh
from taichi_sph.geometry.mesh import Booleans, Floats, Integers

Mesh = tuple[Floats, Integers]


def swept(points: Floats, radius: float, around: int = 16) -> Mesh:
    """Open tube along points (n, 3)."""
    along = mesh.unit(np.gradient(points, axis=0))
    first = np.cross(along[0], [0.0, 1.0, 0.0])
    angle = 2 * np.pi * np.arange(around) / around
    rings, faces = [], []
    for k, (middle, t) in enumerate(zip(points, along, strict=True)):
        first = mesh.unit(first - t * (first @ t))
        second = np.cross(t, first)
        circle = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
        rings.append(middle + radius * circle)
        for j in range(around if k else 0):
            a, b = (k - 1) * around + j, (k - 1) * around + (j + 1) % around
            faces += [(a, b, b + around), (a, b + around, a + around)]
    return np.concatenate(rings), np.array(faces)


def straight(length: float, radius: float, around: int = 16, rings: int = 7) -> Mesh:
    """Open tube along z from 0."""
    z = np.linspace(0.0, length, rings)
    return swept(np.stack([0 * z, 0 * z, z], axis=1), radius, around)


def domed(low: float, high: float, rings: int = 1, around: int = 16, aside: float = 0.0) -> Mesh:
    """Closed tube of radius 4 and length 40; its caps bulge by so many radii.

    One ring is a cone, whose tip may lie aside [radii]; more make a dome.
    """
    vertices, faces = straight(40.0, 4.0, around)
    rows, triangles = vertices.tolist(), faces.tolist()
    for base, sign, bulge in ((0, -1, low), (len(vertices) - around, 1, high)):
        ring, level = [base + j for j in range(around)], vertices[base, 2]
        for k in range(1, rings + 1):
            f = 1 - k / rings
            z = level + sign * 4.0 * bulge * (1 - f * f)
            new = [len(rows)] * around if k == rings else [len(rows) + j for j in range(around)]
            if k == rings:
                rows.append([4.0 * aside, 0.0, z])
            else:
                rows += [[*(f * vertices[base + j, :2]), z] for j in range(around)]
            for j in range(around):
                a, b, c, d = ring[j], ring[(j + 1) % around], new[j], new[(j + 1) % around]
                both = [(a, b, d)] if k == rings else [(a, b, d), (a, d, c)]
                triangles += [t if sign > 0 else t[::-1] for t in both]
            ring = new
    return np.array(rows), np.array(triangles)


def capped(vertices: Floats, faces: Integers) -> Mesh:
    """A surface with its holes filled by fans."""
    for loop in mesh.boundary_loops(faces):
        middle = len(vertices)
        vertices = np.vstack([vertices, vertices[loop].mean(axis=0)])
        fan = np.stack([np.roll(loop, -1), loop, np.full(len(loop), middle)], axis=1)
        faces = np.concatenate([faces, fan])
    return vertices, faces


def with_branch(radius: float, thin: float, length: float) -> Mesh:
    """Open tube of a radius and of length 60 with a thin branch half way, so long."""
    m, around = 3, 24
    half = np.arcsin(thin / radius)
    round_it = np.linspace(half, 2 * np.pi - half, around)[1:-1]
    angle = np.concatenate([np.linspace(-half, half, m + 1), round_it])
    z = np.concatenate(
        [
            np.linspace(0, 30 - thin, 6),
            np.linspace(30 - thin, 30 + thin, m + 1)[1:-1],
            np.linspace(30 + thin, 60, 6),
        ]
    )
    n, row = len(angle), 5
    grid = [(radius * np.cos(a), radius * np.sin(a), q) for q in z for a in angle]
    faces: list[tuple[int, int, int]] = []
    for k in range(len(z) - 1):
        for j in range(n):
            if not (row <= k < row + m and j < m):
                a, b = k * n + j, k * n + (j + 1) % n
                faces += [(a, b, b + n), (a, b + n, a + n)]
    ring = [row * n + j for j in range(m)] + [(row + i) * n + m for i in range(m)]
    ring += [(row + m) * n + j for j in range(m, 0, -1)]
    ring += [(row + i) * n for i in range(m, 0, -1)]
    phase = [np.arctan2(grid[i][2] - 30, grid[i][1]) for i in ring]
    for s in np.linspace(0, length, 5)[1:]:
        new = list(range(len(grid), len(grid) + len(ring)))
        grid += [(radius + s, thin * np.cos(p), 30 + thin * np.sin(p)) for p in phase]
        for j in range(len(ring)):
            a, b = ring[j], ring[(j + 1) % len(ring)]
            c, d = new[j], new[(j + 1) % len(ring)]
            faces += [(a, b, d), (a, d, c)]
        ring = new
    return np.array(grid), np.array(faces)


def hairpin(gap: float, radius: float = 3.0, around: int = 12, lower: float = 0.0) -> Mesh:
    """Two legs 40 long, so far apart, joined below; the second ends `lower` below the first."""
    c = radius + gap / 2
    z, a = np.linspace(40.0, 0.0, 9), np.linspace(0, np.pi, 9)[1:-1]
    up = np.linspace(0.0, 40.0 - lower, 9)
    down = np.stack([-c + 0 * z, 0 * z, z], 1)
    bend = np.stack([-c * np.cos(a), 0 * a, -c * np.sin(a)], 1)
    back = np.stack([c + 0 * up, 0 * up, up], 1)
    return swept(np.concatenate([down, bend, back]), radius, around)


def joined(*meshes: Mesh) -> Mesh:
    """Several meshes as one."""
    start = np.cumsum([0, *(len(v) for v, _ in meshes)])
    faces = [f + k for (_, f), k in zip(meshes, start, strict=False)]
    return np.concatenate([v for v, _ in meshes]), np.concatenate(faces)


def wall_solid(outer: Mesh, inner: Mesh, around: int) -> Mesh:
    """Two tubes of as many rings, joined by ring-shaped ends: the solid of a wall."""
    vertices, faces = joined(outer, (inner[0], inner[1][:, ::-1]))
    k, last = len(outer[0]), len(outer[0]) - around
    ends = []
    for base, flip in ((0, True), (last, False)):
        for j in range(around):
            a, b = base + j, base + (j + 1) % around
            for t in ((a, b, k + b), (a, k + b, k + a)):
                ends.append(t[::-1] if flip else t)
    return vertices, np.concatenate([faces, np.array(ends)])


def from_voxels(inside: Callable[[Floats], Booleans], size: Floats, voxel: float) -> Mesh:
    """Marching cubes over voxels that are in or out, as of a segmentation's labels."""
    count = [int(np.ceil(s / voxel)) + 4 for s in size]
    lines = [(np.arange(k) - 2) * voxel for k in count]
    places = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)
    values = 0.5 - inside(places).astype(float)
    vertices, faces, _ = igl.marching_cubes(
        np.ascontiguousarray(values.transpose(2, 1, 0).reshape(-1)),
        np.ascontiguousarray(places.transpose(2, 1, 0, 3).reshape(-1, 3)),
        *count,
        0.0,
    )
    faces = np.asarray(faces, np.int64)
    if mesh.enclosed_volume(vertices, faces) < 0:
        faces = faces[:, ::-1].copy()
    return vertices, faces


def write_stl(path: Path, surface: Mesh) -> Path:
    """Write a binary STL."""
    path.write_bytes(binary_stl(*surface))
    return path
