"""Distance to a vessel that is not yet cut: a smooth union of branches and bulges."""

import math
from typing import Literal

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial import cKDTree

from app.scenes.vessel_table import Branch, Centrelines, End
from taichi_sph.errors import InputError
from taichi_sph.geometry import mesh
from taichi_sph.geometry.mesh import Floats, Integers

_NEAREST = 7
"""Cones of a branch that are tried for the distance to a point."""


class Swept:
    """Distance to one branch: short round cones with elliptic sections."""

    def __init__(self, branch: Branch, end: End | None):
        """Lay cones along a branch, prolonged by a radius beyond its end if it has one."""
        points = np.array(branch.points, float)
        ellipse = np.array(branch.ellipse or np.zeros((len(points), 3)), float)
        table = np.concatenate([points, ellipse], axis=1)
        chord = np.linalg.norm(np.diff(points[:, :3], axis=0), axis=1)
        t = np.concatenate([[0.0], np.cumsum(chord)])
        edge_order: Literal[1, 2] = 2 if len(t) > 2 else 1
        curve = CubicHermiteSpline(t, table, np.gradient(table, t, axis=0, edge_order=edge_order))
        steps = max(2, math.ceil(t[-1] / (0.25 * points[:, 3].mean())))
        rows = curve(np.linspace(0.0, t[-1], steps + 1))
        if end is not None:
            share = np.linspace(0.0, 1.0, 5)[1:, None]
            beyond = np.repeat(rows[-1:], len(share), axis=0)
            beyond[:, :3] += share * rows[-1, 3] * np.array(end.normal)
            rows = np.concatenate([rows, beyond])
        start, stop = rows[:-1], rows[1:]
        along = stop[:, :3] - start[:, :3]
        self.start, self.length = start[:, :3], np.linalg.norm(along, axis=1)
        self.radius, self.growth = start[:, 3], stop[:, 3] - start[:, 3]
        self.tangent = mesh.unit(along)
        out = 0.5 * (start[:, 4:] + stop[:, 4:])
        out = out - np.einsum("ij,ij->i", out, self.tangent)[:, None] * self.tangent
        self.stretch = np.exp(0.5 * np.linalg.norm(out, axis=1))
        self.major = mesh.unit(out)
        self.middles = cKDTree(start[:, :3] + 0.5 * along)
        widest = (self.stretch * rows[:, 3].max()).max()
        self.margin = float(widest + 0.5 * self.length.max())
        self.least_radius = float((rows[:, 3].min() / self.stretch).min())

    def bounds(self, points: Floats) -> tuple[Floats, Floats]:
        """Least and greatest value that the distance of points (k, 3) may have [mm], (k,)."""
        apart = self.middles.query(points)[0]
        return apart - self.margin, apart - self.least_radius

    def __call__(self, points: Floats) -> Floats:
        """Distance of points (k, 3) [mm], exact to first order at the surface, (k,)."""
        chunks = np.array_split(points, len(points) // 20_000 + 1)
        return np.concatenate([self._distance(chunk) for chunk in chunks])

    def _distance(self, points: Floats) -> Floats:
        # The cones are short, a quarter radius: the nearest ones hold the foot of every point.
        count = min(_NEAREST, len(self.start))
        near = self.middles.query(points, k=count)[1].reshape(len(points), count)

        def component(directions: Floats) -> Floats:
            """Of the way from each cone's start, along its direction, (k, count)."""
            offset = np.einsum("ij,ij->i", self.start, directions)
            return np.take_along_axis(points @ directions.T - offset, near, axis=1)

        axial = component(self.tangent)
        u = component(self.major) ** 2
        square = ((points[:, None] - self.start[near]) ** 2).sum(axis=2)
        v = np.maximum(square - axial**2 - u, 0.0)
        length = self.length[near]
        share = np.clip(axial / length, 0.0, 1.0)
        w = (axial - share * length) ** 2
        radius = self.radius[near] + share * self.growth[near]
        # Ellipsoid of semi-axes r a, r / a, r: distance (f - 1) f / |grad f| (Taubin).
        a = self.stretch[near] ** 2
        size = np.sqrt(u / a + v * a + w) / radius
        slope = np.sqrt(u / a**2 + v * a**2 + w) / radius
        # On the axis the quotient is undetermined; the minor axis is the distance there.
        ratio = np.where(slope > 1e-9, size / np.maximum(slope, 1e-9), 1.0 / np.sqrt(a))
        return (np.maximum((size - 1.0) * ratio, -1.0) * radius).min(axis=1)


class SmoothUnion:
    """Smooth union of a vessel's branches and bulges, not yet cut."""

    def __init__(self, shape: Centrelines):
        """Check that a table's branches fit its openings and lay their cones.

        Raises:
            InputError: they do not.
        """
        ends = {end.name: end for end in shape.openings}
        for branch in shape.branches:
            if branch.end is not None and branch.end not in ends:
                raise InputError(
                    f"{shape.name}: branch {branch.name!r} ends at {branch.end!r}, which is no "
                    f"opening; allowed: {', '.join(ends)}"
                )
            if branch.ellipse is not None and len(branch.ellipse) != len(branch.points):
                raise InputError(
                    f"{shape.name}: branch {branch.name!r} has {len(branch.ellipse)} ellipses for "
                    f"{len(branch.points)} points; there must be one for each"
                )
            if len(branch.points) < 2:
                raise InputError(f"{shape.name}: branch {branch.name!r} needs two points or more")
        self.branches = [Swept(b, None if b.end is None else ends[b.end]) for b in shape.branches]
        self.spheres = np.array([bulge.sphere for bulge in shape.extras]).reshape(-1, 4)
        self.k = shape.smoothing_length

    def __call__(self, points: Floats) -> Floats:
        """Distance of points (k, 3) [mm], (k,)."""
        bounds = [branch.bounds(points) for branch in self.branches]
        # What is further than this counts for nothing in the union: exp(-10).
        enough = np.min([most for _, most in bounds], axis=0) + 10.0 * self.k
        parts = []
        for branch, (least, _) in zip(self.branches, bounds, strict=True):
            near = least < enough
            part = enough.copy()
            part[near] = branch(points[near])
            parts.append(part)
        parts += [np.linalg.norm(points - s[:3], axis=1) - s[3] for s in self.spheres]
        all_parts = np.stack(parts)
        least = all_parts.min(axis=0)
        return least - self.k * np.log(np.exp((least - all_parts) / self.k).sum(axis=0))

    def gradient(self, points: Floats, step: float) -> Floats:
        """Slope by central differences over `step` [mm], (k, 3)."""
        result = np.empty_like(points)
        for axis in range(3):
            shift = np.zeros(3)
            shift[axis] = step
            result[:, axis] = (self(points + shift) - self(points - shift)) / (2 * step)
        return result

    def settle(self, vertices: Floats, faces: Integers, step: float) -> Floats:
        """Bring the vertices (n, 3) of a mesh onto the surface, roughly, along its normals [mm]."""
        return vertices - np.clip(self(vertices), -step, step)[:, None] * mesh.vertex_normals(
            vertices, faces
        )

    def project(self, points: Floats, step: float, rounds: int) -> Floats:
        """Bring points (k, 3) near the surface onto it by Newton's method, (k, 3) [mm]."""
        for _ in range(rounds):
            value, slope = self(points), self.gradient(points, 0.05 * step)
            square = np.maximum(np.einsum("ij,ij->i", slope, slope), 0.1)
            move = np.clip(value / square, -step, step)
            points = points - move[:, None] * slope
        return points
