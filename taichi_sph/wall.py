"""The wall: a layer of fixed proxy particles behind the lumen surface (paper, 1.1)."""

from dataclasses import dataclass

import numpy as np
import taichi as ti
from scipy.spatial import cKDTree

from taichi_sph.smoothing_kernels import WendlandC2


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
    given: tuple[np.ndarray, np.ndarray, np.ndarray]
    """The same three in the order in which they were given; the lists put them into the fields."""
    tool: int
    """Proxies of a tool: rows count to count + tool, which no cell holds."""
    velocity: ti.MatrixField
    """v_k [m/s], shape as position where proxies move, else (1,)."""

    @property
    def moves(self) -> bool:
        """Whether any proxy may move."""
        return self.tool > 0

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
    ) -> "Wall":
        """Proxies at given positions [m] and outward normals, shape (m, 3).

        `period` [m] repeats the wall along the axes where it is not zero; there is room for the
        proxies of a tool.
        """
        m = len(position)
        rows = max(m + tool, 1)
        return cls(
            count=m,
            setback=setback,
            spacing=spacing,
            position=ti.Vector.field(3, float, rows),
            normal=ti.Vector.field(3, float, rows),
            volume=ti.field(float, rows),
            given=(position, normal, proxy_volumes(position, kernel, period) if m else np.zeros(0)),
            tool=tool,
            velocity=ti.Vector.field(3, float, rows if tool else 1),
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
