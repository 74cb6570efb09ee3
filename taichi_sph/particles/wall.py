"""The wall: a layer of proxy particles behind the lumen surface (paper, 1.1).

They stand still, or move out and back along their normals as the vessel's pulse wants it.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import taichi as ti
from scipy.spatial import cKDTree

from taichi_sph.particles.smoothing_kernel import WendlandC2


class Proxies(NamedTuple):
    """Proxies in any order, on the host."""

    position: np.ndarray
    """x_k [m], (m, 3); of a wall that pulses, at its narrowest."""
    normal: np.ndarray
    """Unit normal out of the lumen, (m, 3)."""
    volume: np.ndarray
    """V_k of Eq. 3 with gamma = 1 [m^3], (m,)."""
    swing: np.ndarray
    """How far a proxy moves along its normal in a pulse [m], (m,)."""
    wide_volume: np.ndarray
    """V_k where all have moved as far [m^3], (m,)."""

    def at(self, level: float) -> np.ndarray:
        """Positions [m], (m, 3), at a level of the pulse, 0 narrow to 1 wide."""
        return np.asarray(self.position + level * self.swing[:, None] * self.normal)


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
    given: Proxies
    """The same in the order in which they were given; the lists put them into the fields."""
    swing: ti.MatrixField
    """Way from narrow to wide [m], shape as position where the wall pulses, else (1,)."""
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
    most_swing: float = 0.0
    """Of any proxy [m]."""
    level: float = 0.0
    """Where the pulse is, 0 narrow to 1 wide."""
    rate: float = 0.0
    """Its rate [1/s]."""

    @property
    def moves(self) -> bool:
        """Whether any proxy may move."""
        return self.tool > 0 or self.pulses

    @property
    def pulses(self) -> bool:
        """Whether the vessel's own proxies move."""
        return self.most_swing > 0.0

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
        swing: np.ndarray | None = None,
    ) -> "Wall":
        """Proxies at given positions [m] and outward normals, shape (m, 3).

        `period` [m] repeats the wall along the axes where it is not zero; there is room for the
        proxies of a tool.  `swing` [m], (m,), is the way of each along its normal in a pulse.
        """
        m = len(position)
        rows = max(m + tool, 1)
        volume = proxy_volumes(position, kernel, period) if m else np.zeros(0)
        most = 0.0 if swing is None else float(swing.max(initial=0.0))
        given = Proxies(position, normal, volume, np.zeros(m), volume)
        if swing is not None and most > 0.0:
            wide = position + swing[:, None] * normal
            given = Proxies(position, normal, volume, swing, proxy_volumes(wide, kernel, period))
        moving, pulsing = rows if tool or most else 1, rows if most else 1
        return cls(
            count=m,
            setback=setback,
            spacing=spacing,
            position=ti.Vector.field(3, float, rows),
            normal=ti.Vector.field(3, float, rows),
            volume=ti.field(float, rows),
            given=given,
            swing=ti.Vector.field(3, float, pulsing),
            narrow=ti.Vector.field(3, float, pulsing),
            narrow_volume=ti.field(float, pulsing),
            wide_volume=ti.field(float, pulsing),
            tool=tool,
            velocity=ti.Vector.field(3, float, moving),
            most_swing=most,
        )


@ti.func
def wall_velocity(w: ti.template(), k):
    """v_k [m/s]; costs nothing where no proxy moves."""
    v = ti.Vector([0.0, 0.0, 0.0])
    if ti.static(w.moves):
        v = w.velocity[k]
    return v


def proxy_volumes(
    position: np.ndarray, kernel: WendlandC2, period: np.ndarray | None = None
) -> np.ndarray:
    """V_k = 1 / sum_l W(x_k - x_l) over proxies, itself included (Eq. 3), [m^3], shape (m,)."""
    position = np.asarray(position, dtype=np.float64)
    points = position
    if period is not None:
        copies = [position]
        for axis in np.flatnonzero(period):
            shift = np.zeros(3)
            shift[axis] = period[axis]
            copies = [p + s for p in copies for s in (0.0 * shift, shift, -shift)]
        points = np.concatenate(copies)
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
