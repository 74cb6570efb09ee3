"""The wall: a layer of proxy particles behind the lumen surface (paper, 1.1).

They stand still, or move out and back along their normals as the vessel's wall motion wants it.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import taichi as ti
from scipy.spatial import cKDTree

from taichi_sph.particles.grid import Points
from taichi_sph.particles.smoothing_kernel import WendlandC2
from taichi_sph.runtime import runtime_number

CURVED_FRICTION = 0.85
"""Friction of a curved wall over a plane one's, less 1, over (kappa_k h_s)^2.

The first layer in a tube of radius a, one spacing d thick, passes on what drives all of the blood:
1/((1 - x/2)(1 - x/4)) times as much a particle as at a plane wall, at the speed that the parabola
has there, x = d/a.  The proxies all round it give 1.06, 1.15, 1.19 and 1.26 of that by themselves
at x = 0.1, 0.25, 0.33 and 0.5; this is the rest (docs/physics.md)."""
LARGEST_CURVATURE = 0.5
"""Upper bound of kappa_k h_s: a tube of four spacings across; narrower ones hold no flow."""
CURVATURE_REACH = 1.5
"""The wall's curvature is that within so many support radii."""
SAME_WAY = 0.3
"""Cosine between the normals of proxies of one wall: at an edge and across a septum it is less."""
SMALLEST_SHRINKAGE = 0.4
"""Lower bound of a tube's radius over the radius that its proxies are on."""


class Proxies(NamedTuple):
    """Proxies in any order, on the host."""

    position: np.ndarray
    """x_k [m], (m, 3); of a wall that moves, at its narrowest."""
    normal: np.ndarray
    """Unit normal out of the lumen, (m, 3)."""
    volume: np.ndarray
    """V_k of Eq. 3 with gamma = 1 [m^3], (m,)."""
    amplitude: np.ndarray
    """How far a proxy moves along its normal, from narrow to wide [m], (m,)."""
    wide_volume: np.ndarray
    """V_k where all have moved as far [m^3], (m,)."""
    curvature: np.ndarray
    """kappa_k h_s of the wall, see `wall_curvature` [-], (m,)."""

    def at(self, factor: float) -> np.ndarray:
        """Positions [m], (m, 3), at a displacement factor, 0 narrow to 1 wide."""
        return np.asarray(self.position + factor * self.amplitude[:, None] * self.normal)


@dataclass(eq=False)
class Wall:
    """Proxy particles in the order of the neighbour grid."""

    count: int
    """Number of proxies."""
    setback: float
    """Distance of the proxies behind the lumen surface [m]."""
    spacing: float
    """Mean spacing of the proxies on the surface [m]."""
    position: ti.MatrixField
    """x_k [m], shape (max(count, 1),)."""
    normal: ti.MatrixField
    """Unit normal out of the lumen, shape (max(count, 1),)."""
    volume: ti.Field
    """V_k of Eq. 3 with gamma = 1 [m^3], shape (max(count, 1),)."""
    friction: ti.Field
    """Factor F_k of the friction of a curved wall [-], shape (max(count, 1),)."""
    given: Proxies
    """The same in the order in which they were given; the lists put them into the fields."""
    displacement: ti.MatrixField
    """From narrow to wide [m], shape as position where the vessel's wall moves, else (1,)."""
    narrow: ti.MatrixField
    """Position at the narrowest [m], likewise."""
    narrow_volume: ti.Field
    """Volume at the narrowest [m^3], likewise."""
    wide_volume: ti.Field
    """Volume at the widest [m^3], likewise."""
    tool: int
    """Proxies of a tool: rows count to count + tool, which no cell holds."""
    velocity: ti.MatrixField
    """v_k [m/s], shape as position where proxies move, else (1,)."""
    order: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    """Row of `given` of each proxy in the fields, (m,)."""
    largest_amplitude: float = 0.0
    """The farthest that any of the vessel's proxies moves from narrow to wide [m]."""
    displacement_factor: float = 0.0
    """Where the vessel's wall is, 0 narrow to 1 wide."""
    rate: float = 0.0
    """Rate of the displacement factor [1/s]."""

    @property
    def moves(self) -> bool:
        """Whether any proxy may move."""
        return self.tool > 0 or self.vessel_moves

    @property
    def vessel_moves(self) -> bool:
        """Whether the vessel's own proxies move."""
        return self.largest_amplitude > 0.0

    @classmethod
    def from_numpy(
        cls,
        position: np.ndarray,
        normal: np.ndarray,
        kernel: WendlandC2,
        setback: float,
        spacing: float,
        period: np.ndarray | None = None,
        tool: int = 0,
        amplitude: np.ndarray | None = None,
    ) -> "Wall":
        """Proxies at given positions [m] and outward normals, shape (m, 3).

        `period` [m] repeats the wall along the axes where it is not zero; there is room for the
        proxies of a tool.  `amplitude` [m], (m,), is how far each moves along its normal.

        Raises:
            RunError: Taichi was not started, or in another process or thread.
        """
        runtime_number()
        m = len(position)
        rows = max(m + tool, 1)
        volume = proxy_volumes(position, kernel, period) if m else np.zeros(0)
        most = 0.0 if amplitude is None else float(amplitude.max(initial=0.0))
        curvature = wall_curvature(position, normal, kernel, setback, period)
        given = Proxies(position, normal, volume, np.zeros(m), volume, curvature)
        if amplitude is not None and most > 0.0:
            wide = position + amplitude[:, None] * normal
            given = given._replace(
                amplitude=amplitude, wide_volume=proxy_volumes(wide, kernel, period)
            )
        moving, swaying = rows if tool or most else 1, rows if most else 1
        return cls(
            count=m,
            setback=setback,
            spacing=spacing,
            position=ti.Vector.field(3, float, rows),
            normal=ti.Vector.field(3, float, rows),
            volume=ti.field(float, rows),
            friction=ti.field(float, rows),
            given=given,
            displacement=ti.Vector.field(3, float, swaying),
            narrow=ti.Vector.field(3, float, swaying),
            narrow_volume=ti.field(float, swaying),
            wide_volume=ti.field(float, swaying),
            tool=tool,
            velocity=ti.Vector.field(3, float, moving),
            largest_amplitude=most,
        )


def move_wall(wall: Wall, points: Points, factor: float, rate: float) -> None:
    """Put a wall that moves at a displacement factor, 0 narrow to 1 wide, with its rate [1/s].

    `points` are its proxies as the lists know them.
    """
    wall.displacement_factor, wall.rate = factor, rate
    if wall.vessel_moves:
        move_proxies(wall, points, len(wall.given.position), factor, rate)


@ti.func
def wall_velocity(w: ti.template(), k):
    """v_k [m/s]; costs nothing where no proxy moves."""
    v = ti.Vector([0.0, 0.0, 0.0])
    if ti.static(w.moves):
        v = w.velocity[k]
    return v


@ti.kernel
def place_proxies(
    w: ti.template(),
    points: ti.template(),
    position: ti.types.ndarray(ndim=2),
    normal: ti.types.ndarray(ndim=2),
    volume: ti.types.ndarray(ndim=1),
    amplitude: ti.types.ndarray(ndim=1),
    wide_volume: ti.types.ndarray(ndim=1),
    curvature: ti.types.ndarray(ndim=1),
):
    """Proxies in the order of the grid.  Writes: the wall's fields, points."""
    for k in range(volume.shape[0]):
        for a in ti.static(range(3)):
            w.position[k][a] = position[k, a]
            w.normal[k][a] = normal[k, a]
        w.volume[k] = volume[k]
        w.friction[k] = 1.0 + CURVED_FRICTION * curvature[k] * curvature[k]
        if ti.static(w.vessel_moves):
            w.narrow[k] = w.position[k]
            w.displacement[k] = amplitude[k] * w.normal[k]
            w.narrow_volume[k] = volume[k]
            w.wide_volume[k] = wide_volume[k]
        points.x[k] = position[k, 0]
        points.y[k] = position[k, 1]
        points.z[k] = position[k, 2]


@ti.kernel
def move_proxies(w: ti.template(), points: ti.template(), count: int, factor: float, rate: float):
    """x_k = narrow + factor displacement, v_k = rate displacement.

    V_k (Eq. 3) is on a line between its values at the narrowest and at the widest; the normals are
    those at the narrowest.  Writes: position, velocity, volume, points.
    """
    for k in range(count):
        x = w.narrow[k] + factor * w.displacement[k]
        w.position[k] = x
        w.velocity[k] = rate * w.displacement[k]
        w.volume[k] = w.narrow_volume[k] + factor * (w.wide_volume[k] - w.narrow_volume[k])
        points.x[k] = x[0]
        points.y[k] = x[1]
        points.z[k] = x[2]


@ti.kernel
def place_tool(
    w: ti.template(),
    points: ti.template(),
    ball: ti.template(),
    position: ti.types.ndarray(ndim=2),
    normal: ti.types.ndarray(ndim=2),
    velocity: ti.types.ndarray(ndim=2),
    volume: ti.types.ndarray(ndim=1),
    x: float,
    y: float,
    z: float,
    radius: float,
):
    """Put a tool's proxies into the wall's rows from count on, and where the lists look for them.

    Writes: position, normal, velocity, volume, friction, points, ball.
    """
    ball[0] = x
    ball[1] = y
    ball[2] = z
    ball[3] = radius
    for k in range(volume.shape[0]):
        for a in ti.static(range(3)):
            w.position[w.count + k][a] = position[k, a]
            w.normal[w.count + k][a] = normal[k, a]
            w.velocity[w.count + k][a] = velocity[k, a]
        w.volume[w.count + k] = volume[k]
        w.friction[w.count + k] = 1.0
        points.x[k] = position[k, 0]
        points.y[k] = position[k, 1]
        points.z[k] = position[k, 2]


def wall_curvature(
    position: np.ndarray,
    normal: np.ndarray,
    kernel: WendlandC2,
    setback: float,
    period: np.ndarray | None = None,
) -> np.ndarray:
    """Sum kappa_k of the lumen's principal curvatures at each proxy, times h_s [-], shape (m,).

    1/a in a tube of radius a.  Twice the mean over the proxies beside it, those that look the same
    way, of (n_l - n_k).(x_l - x_k)/|x_l - x_k|^2, for a tube that is a setback narrower.  From 0,
    where the wall is plane or bulges into the blood, to LARGEST_CURVATURE.

    Args:
        position: x_k [m], (m, 3).
        normal: unit normals out of the lumen, (m, 3).
        kernel: its h_s is the unit of length.
        setback: of the proxies behind the lumen's surface [m].
        period: the wall repeats along the axes where it is not zero [m], (3,).
    """
    m = len(position)
    points = _copies(np.asarray(position, dtype=np.float64), period)
    normals = np.tile(normal, (len(points) // max(m, 1), 1))
    pairs = cKDTree(points).query_pairs(
        CURVATURE_REACH * kernel.support_radius, output_type="ndarray"
    )
    k, l = np.concatenate([pairs, pairs[:, ::-1]]).T
    beside = (k < m) & ((normals[k] * normals[l]).sum(axis=1) > SAME_WAY)
    k, l = k[beside], l[beside]
    apart = points[l] - points[k]
    bend = ((normals[l] - normals[k]) * apart).sum(axis=1) / (apart**2).sum(axis=1)
    count = np.bincount(k, minlength=m)
    behind = 2.0 * np.bincount(k, bend, m) / np.maximum(count, 1)
    at_surface = behind / np.maximum(1.0 - setback * behind, SMALLEST_SHRINKAGE)
    return np.clip(kernel.smoothing_length * at_surface, 0.0, LARGEST_CURVATURE)


def _copies(position: np.ndarray, period: np.ndarray | None) -> np.ndarray:
    """Points [m], (m, 3), and after them their periodic copies."""
    copies = [position]
    if period is not None:
        for axis in np.flatnonzero(period):
            shift = np.zeros(3)
            shift[axis] = period[axis]
            copies = [p + s for p in copies for s in (0.0 * shift, shift, -shift)]
    return np.concatenate(copies)


def proxy_volumes(
    position: np.ndarray, kernel: WendlandC2, period: np.ndarray | None = None
) -> np.ndarray:
    """V_k = 1 / sum_l W(x_k - x_l) over proxies, itself included (Eq. 3), [m^3], shape (m,)."""
    position = np.asarray(position, dtype=np.float64)
    points = _copies(position, period)
    pairs = cKDTree(points).query_pairs(kernel.support_radius, output_type="ndarray")
    w = kernel.w_of(np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1))
    total = np.full(len(points), kernel.peak)
    total += np.bincount(pairs[:, 0], weights=w, minlength=len(points))
    total += np.bincount(pairs[:, 1], weights=w, minlength=len(points))
    return 1.0 / total[: len(position)]


def refreshed_volumes(
    position: np.ndarray, volume: np.ndarray, kernel: WendlandC2, near: np.ndarray
) -> np.ndarray:
    """Volumes where proxies came or went: those of `near` (m,) anew, the others as they are.

    All proxies within a support radius of a change must be among `near`.
    """
    volume = volume.copy()
    tree = cKDTree(position)
    for k, members in zip(
        np.flatnonzero(near),
        tree.query_ball_point(position[near], kernel.support_radius),
        strict=True,
    ):
        volume[k] = 1.0 / kernel.w_of(np.linalg.norm(position[members] - position[k], axis=1)).sum()
    return volume
