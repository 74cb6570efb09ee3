"""Closed surface of a lumen or a tool: what lies inside, how far, where it is nearest."""

from functools import cached_property

import igl
import numpy as np

from taichi_sph.geometry.mesh import Booleans, Floats, Integers, NearestPoint


class ClosedSurface:
    """Triangles round a volume, outward; their trees are built once, when first asked for."""

    def __init__(self, vertices: Floats, faces: Integers):
        """Take triangles `faces` (m, 3) of `vertices` (n, 3)."""
        self.vertices = np.ascontiguousarray(vertices, np.float64)
        self.faces = np.ascontiguousarray(faces, np.int64)

    @cached_property
    def _winding(self) -> igl.FastWindingNumberBVH:
        tree = igl.FastWindingNumberBVH()
        tree.init(self.vertices, self.faces)
        return tree

    @cached_property
    def _nearest(self) -> NearestPoint:
        return NearestPoint(self.vertices, self.faces)

    def contains(self, points: Floats) -> Booleans:
        """Which points (k, 3) lie within."""
        if len(points) == 0:
            return np.zeros(0, bool)
        points = np.ascontiguousarray(points, np.float64)
        return np.asarray(self._winding.winding_number(points)).reshape(-1) > 0.5

    def distance(self, points: Floats) -> Floats:
        """Distance of points (k, 3) to the surface, (k,)."""
        return self._nearest(points)[0]

    def nearest(self, points: Floats) -> tuple[Floats, Integers, Floats]:
        """Distance (k,), triangle (k,) and place (k, 3) nearest to points (k, 3)."""
        return self._nearest(points)

    def signed_distance(self, points: Floats) -> Floats:
        """Distance of points (k, 3) to the surface, negative within, (k,)."""
        return np.where(self.contains(points), -1.0, 1.0) * self.distance(points)
