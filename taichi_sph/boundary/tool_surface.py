"""Surface of a rigid tool, sampled as proxies about its own origin."""

from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np

from taichi_sph.errors import InputError
from taichi_sph.geometry import wall_sampling
from taichi_sph.geometry.mending import mend
from taichi_sph.geometry.mesh import Booleans, Floats, Integers, NearestPoint, is_closed
from taichi_sph.geometry.surface_file import load_surface, require_manifold, require_outward
from taichi_sph.particles.smoothing_kernel import WendlandC2
from taichi_sph.particles.wall import proxy_volumes
from taichi_sph.scene import ToolTable


@dataclass(frozen=True, eq=False)
class ToolSurface:
    """Proxies of a tool, and its surface, about its own origin."""

    position: Floats
    """Proxies, set back inside the tool [m], (n, 3)."""
    normal: Floats
    """Unit normals into the tool, that is out of the blood, (n, 3)."""
    volume: Floats
    """V_k of Eq. 3 [m^3], (n,)."""
    vertices: Floats
    """Corners of the surface [m], (v, 3)."""
    faces: Integers
    """(f, 3)."""
    radius: float
    """Radius of a ball about the origin that holds the proxies [m]."""

    def outside(self, points: Floats) -> Booleans:
        """Which points (n, 3) [m], about the tool's origin, lie outside it."""
        tree = igl.FastWindingNumberBVH()
        tree.init(np.ascontiguousarray(self.vertices), np.ascontiguousarray(self.faces, np.int64))
        turns = tree.winding_number(np.ascontiguousarray(points, np.float64))
        return np.asarray(turns).reshape(-1) < 0.5

    def distance(self, points: Floats) -> Floats:
        """Distance of points (n, 3) [m], about the tool's origin, to its surface [m], (n,)."""
        return NearestPoint(self.vertices, self.faces)(points)[0]


def read_tool_surface(
    table: ToolTable, folder: Path, spacing: float, setback: float, kernel: WendlandC2
) -> ToolSurface:
    """Sample the surface of a scene's tool.

    Args:
        table: the scene's.
        folder: where its surface file is.
        spacing: of the proxies [m].
        setback: how far inside the surface they stand [m].
        kernel: of the blood.

    Raises:
        InputError: the surface cannot be used.
    """
    path = folder / table.surface
    vertices, faces = load_surface(path)
    vertices, faces, _ = mend(vertices * table.scale, faces, str(path))
    require_manifold(vertices, faces, str(path), table.scale)
    if not is_closed(faces):
        raise InputError(f"{path}: the tool's surface has holes; it must be closed")
    require_outward(vertices, faces, str(path))
    points, nearest = wall_sampling.relaxed_points(vertices, faces, spacing, seed=0)
    outward = wall_sampling.normals_at(vertices, faces, points, nearest)
    position = points - setback * outward
    surface = ToolSurface(
        position, -outward, proxy_volumes(position, kernel), vertices, faces,
        float(np.linalg.norm(position, axis=1).max()),
    )  # fmt: skip
    outside = int(surface.outside(position).sum())
    if outside:
        raise InputError(
            f"{path}: the tool is thinner than {2.0 * setback:.3g} m in places ({outside} of "
            f"{len(position)} proxies do not fit in it); make it thicker or the spacing smaller"
        )
    return surface
