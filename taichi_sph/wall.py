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

    @classmethod
    def from_numpy(
        cls,
        position: np.ndarray,
        normal: np.ndarray,
        kernel: WendlandC2,
        setback: float,
        spacing: float,
        period: np.ndarray | None = None,
    ) -> "Wall":
        """Proxies at given positions [m] and outward normals, shape (m, 3).

        `period` [m] repeats the wall along the axes where it is not zero.
        """
        m = len(position)
        return cls(
            count=m,
            setback=setback,
            spacing=spacing,
            position=ti.Vector.field(3, float, max(m, 1)),
            normal=ti.Vector.field(3, float, max(m, 1)),
            volume=ti.field(float, max(m, 1)),
            given=(position, normal, proxy_volumes(position, kernel, period) if m else np.zeros(0)),
        )


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
