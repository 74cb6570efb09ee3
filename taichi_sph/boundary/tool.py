"""A rigid tool: a closed surface sampled as proxies, moved from outside, felt by the blood."""

import math
from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np
import taichi as ti
from scipy.spatial.transform import Rotation

from taichi_sph.errors import InputError
from taichi_sph.geometry import wall_sampling
from taichi_sph.geometry.mending import mend
from taichi_sph.geometry.mesh import Booleans, Floats, Integers, NearestPoint, is_closed
from taichi_sph.geometry.surface_file import load_surface, require_manifold, require_outward
from taichi_sph.particles.neighbors import Neighbors
from taichi_sph.particles.smoothing_kernel import WendlandC2
from taichi_sph.particles.wall import Wall, proxy_volumes
from taichi_sph.runtime import float_dtype
from taichi_sph.scene import ToolTable

FOLLOWING = 0.01
"""A tool nears where it is wanted by 1/e in this time [s]: a hand's jumps, which come 30 times a
second, become a motion."""

LARGEST_SPEED = 0.5
"""No part of a tool moves faster [m/s]; a surgeon's hand reaches some 0.2 m/s."""


@dataclass(frozen=True, eq=False)
class Shape:
    """Proxies of a tool about its own origin."""

    position: Floats
    """Set back inside the tool [m], (n, 3)."""
    normal: Floats
    """Unit normals into the tool, that is out of the blood, (n, 3)."""
    volume: Floats
    """V_k of Eq. 3 [m^3], (n,)."""
    vertices: Floats
    """Of the surface [m], (v, 3)."""
    faces: Integers
    """(f, 3)."""
    radius: float
    """Of a ball about the origin that holds the proxies [m]."""

    def clear_of(self, points: Floats) -> Booleans:
        """Which points (n, 3) [m], about the tool's origin, lie outside it."""
        tree = igl.FastWindingNumberBVH()
        tree.init(np.ascontiguousarray(self.vertices), np.ascontiguousarray(self.faces, np.int64))
        turns = tree.winding_number(np.ascontiguousarray(points, np.float64))
        return np.asarray(turns).reshape(-1) < 0.5

    def distance(self, points: Floats) -> Floats:
        """Distance of points (n, 3) [m], about the tool's origin, to its surface [m], (n,)."""
        return NearestPoint(self.vertices, self.faces)(points)[0]


def read_shape(
    table: ToolTable, folder: Path, spacing: float, setback: float, kernel: WendlandC2
) -> Shape:
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
    shape = Shape(
        position, -outward, proxy_volumes(position, kernel), vertices, faces,
        float(np.linalg.norm(position, axis=1).max()),
    )  # fmt: skip
    outside = int(shape.clear_of(position).sum())
    if outside:
        raise InputError(
            f"{path}: the tool is thinner than {2.0 * setback:.3g} m in places ({outside} of "
            f"{len(position)} proxies do not fit in it); make it thicker or the spacing smaller"
        )
    return shape


class Tool:
    """Where the tool is, and where it is wanted; without a shape, a mere point for the suction."""

    def __init__(self, shape: Shape | None, position: Floats):
        """Put it at a position [m]."""
        self.shape = shape
        self.home = np.asarray(position, float)
        """Where it is at the start [m]."""
        self.start_again()

    def start_again(self) -> None:
        """As at the start."""
        self.position = self.home
        self.rotation = Rotation.identity()
        self.wanted_position = self.position
        self.wanted_rotation = self.rotation
        self.velocity = np.zeros(3)
        """[m/s]"""
        self.spin = np.zeros(3)
        """[rad/s]"""
        self._reached: tuple[object, object] = (None, None)

    @property
    def count(self) -> int:
        """Number of proxies."""
        return 0 if self.shape is None else len(self.shape.position)

    @property
    def at_rest(self) -> bool:
        """Whether it stands still."""
        return not (self.velocity.any() or self.spin.any())

    @property
    def settled(self) -> bool:
        """Whether it has come to rest where it is still wanted: most steps of most runs."""
        wanted = self.wanted_position, self.wanted_rotation
        return self._reached[0] is wanted[0] and self._reached[1] is wanted[1]

    def aim(self) -> None:
        """Choose the velocity for the next step; of a tool with a shape, as `move`."""
        assert self.shape is not None
        away = self.wanted_position - self.position
        self.velocity = self._bounded(away, 1.0)
        self.spin = np.zeros(3)
        if self.wanted_rotation is not self.rotation:
            turn = (self.wanted_rotation * self.rotation.inv()).as_rotvec()
            self.spin = self._bounded(turn, self.shape.radius)
        if self.at_rest:
            self._reached = self.wanted_position, self.wanted_rotation

    def jump(self) -> float:
        """Be where it is wanted, for a mere point pushes no blood; returns how far that is [m]."""
        way = math.dist(self.position, self.wanted_position)
        self.position, self.rotation = self.wanted_position, self.wanted_rotation
        self._reached = self.wanted_position, self.wanted_rotation
        return way

    @staticmethod
    def _bounded(way: Floats, arm: float) -> Floats:
        length = math.hypot(*way)
        if length * max(arm, 1e-3) < 1e-7:
            return np.zeros(3)
        speed = length / FOLLOWING
        return way / length * min(speed, 0.5 * LARGEST_SPEED / max(arm, 1e-3))

    def move(self, dt: float) -> float:
        """Move by a step of dt [s]; returns how far a part of it may have gone [m]."""
        self.position = self.position + dt * self.velocity
        if self.spin.any():
            self.rotation = Rotation.from_rotvec(dt * self.spin) * self.rotation
        assert self.shape is not None
        return dt * (math.hypot(*self.velocity) + self.shape.radius * math.hypot(*self.spin))

    def place(self, wall: Wall, neighbors: Neighbors) -> None:
        """Put the proxies into the wall's last rows."""
        if self.shape is None:
            return
        arm = self.rotation.apply(self.shape.position)
        rows = (
            self.position + arm,
            self.rotation.apply(self.shape.normal),
            self.velocity + np.cross(self.spin, arm),
        )
        place_tool(
            wall, neighbors, *(np.ascontiguousarray(a, float_dtype()) for a in rows),
            self.shape.volume.astype(float_dtype()), *map(float, self.position), self.shape.radius,
        )  # fmt: skip


@ti.kernel
def place_tool(
    w: ti.template(),
    nb: ti.template(),
    position: ti.types.ndarray(ndim=2),
    normal: ti.types.ndarray(ndim=2),
    velocity: ti.types.ndarray(ndim=2),
    volume: ti.types.ndarray(ndim=1),
    x: float,
    y: float,
    z: float,
    radius: float,
):
    """Writes: the wall's rows from count on, and what the lists know of them."""
    nb.tool_ball[0] = x
    nb.tool_ball[1] = y
    nb.tool_ball[2] = z
    nb.tool_ball[3] = radius
    for k in range(volume.shape[0]):
        for a in ti.static(range(3)):
            w.position[w.count + k][a] = position[k, a]
            w.normal[w.count + k][a] = normal[k, a]
            w.velocity[w.count + k][a] = velocity[k, a]
        w.volume[w.count + k] = volume[k]
        nb.tool.x[k] = position[k, 0]
        nb.tool.y[k] = position[k, 1]
        nb.tool.z[k] = position[k, 2]
