"""The cell grid: cells over a box, each axis walled or periodic, and points in their order."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import taichi as ti

from taichi_sph.errors import RunError

RUN = 32
"""Candidates that are tested at a time: the bits of an integer."""

REACH = (1, 1, 2)
"""Cells to look at on each side along each axis.  Cells that follow along z are one run of rows,
so half cells along z leave out what is too far there and cost nothing."""


@ti.data_oriented
@dataclass(frozen=True)
class Grid:
    """Cells of one edge over a box, each axis walled or periodic."""

    lower: tuple[float, float, float]
    """Lower corner of the box [m]."""
    cell: tuple[float, float, float]
    """Edge of a cell along each axis [m]."""
    shape: tuple[int, int, int]
    """Number of cells along each axis."""
    period: tuple[float, float, float]
    """Length after which an axis repeats [m]; 0 where it does not."""
    reach: tuple[int, int, int]
    """Cells to look at on each side along each axis."""

    @property
    def cells(self) -> int:
        """Number of cells."""
        return math.prod(self.shape)

    @property
    def periodic(self) -> bool:
        """Whether any axis repeats."""
        return any(self.period)

    @ti.func
    def cell_of(self, x):
        """Cell of a position, clamped to the box."""
        c = ti.Vector([0, 0, 0])
        for a in ti.static(range(3)):
            k = ti.floor((x[a] - self.lower[a]) / self.cell[a], int)
            c[a] = ti.max(0, ti.min(self.shape[a] - 1, k))
        return c

    @ti.func
    def index(self, c):
        """Linear index of a cell; cells that follow along z are neighbours in memory."""
        return (c[0] * self.shape[1] + c[1]) * self.shape[2] + c[2]

    @ti.func
    def separation(self, x_i, x_j):
        """r_ij = x_i - x_j [m], to the nearest image where an axis is periodic."""
        r = x_i - x_j
        for a in ti.static(range(3)):
            if ti.static(self.period[a] > 0.0):
                r[a] -= self.period[a] * ti.round(r[a] / self.period[a])
        return r

    @ti.func
    def wrap(self, x):
        """A position moved back into the box along periodic axes."""
        for a in ti.static(range(3)):
            if ti.static(self.period[a] > 0.0):
                x[a] -= self.period[a] * ti.floor((x[a] - self.lower[a]) / self.period[a])
        return x


def make_grid(
    lower: np.ndarray,
    upper: np.ndarray,
    radius: float,
    period: np.ndarray | None = None,
    reach: tuple[int, int, int] = REACH,
) -> Grid:
    """A grid over the box lower..upper [m] for lists of a radius [m]."""
    period = np.zeros(3) if period is None else np.asarray(period, dtype=float)
    extent = np.where(period > 0.0, period, np.asarray(upper) - np.asarray(lower))
    edge = radius / np.array(reach)
    across = 2 * np.array(reach) + 1
    if np.any((period > 0.0) & (period < across * edge)):
        raise ValueError(f"a periodic axis must be at least {across.min()} cells long")
    shape = np.maximum(1, np.floor(extent / edge * (1.0 + 1e-9))).astype(int)
    shape = np.where(period > 0.0, shape, shape + 1)
    cell = np.where(period > 0.0, extent / shape, edge)
    if float(np.prod(shape.astype(float))) > 2e8:
        raise RunError(
            f"the neighbour grid would need {np.prod(shape.astype(float)):.2g} cells: the vessel "
            f"is too large for this spacing; at most 2e8 are allowed"
        )
    x, y, z = (float(v) for v in lower)
    cx, cy, cz = (float(v) for v in cell)
    nx, ny, nz = (int(v) for v in shape)
    px, py, pz = (float(v) for v in period)
    return Grid((x, y, z), (cx, cy, cz), (nx, ny, nz), (px, py, pz), reach)


BLOCK = 4
"""Edge of the blocks in which cells are switched on or off [cells]."""


def cells_within(
    grid: Grid, distance: Callable[[np.ndarray], np.ndarray], margin: float
) -> np.ndarray:
    """Cells that may hold something within a margin [m] of a body; some beyond it too.

    A vessel fills a small part of its box: 3 % of the portal vein's.

    Args:
        grid: the cells.
        distance: of points (n, 3) to the body [m], negative inside, (n,).
        margin: how far from the body cells are needed [m].

    Returns:
        bool, (cells,), in the order of `Grid.index`.
    """
    cell, lower = np.asarray(grid.cell), np.asarray(grid.lower)
    blocks = [np.arange(0, n, BLOCK) for n in grid.shape]
    corner = np.stack(np.meshgrid(*blocks, indexing="ij"), axis=-1).reshape(-1, 3)
    centre = lower + (corner + 0.5 * BLOCK) * cell
    reach = margin + 0.5 * BLOCK * float(np.linalg.norm(cell))
    near = (distance(centre) < reach).reshape([len(b) for b in blocks])
    for axis, count in enumerate(grid.shape):
        near = np.repeat(near, BLOCK, axis=axis).take(np.arange(count), axis=axis)
    return near.ravel()


@dataclass(eq=False)
class Points:
    """Positions in the order of the grid, coordinate by coordinate: many are tested at a time.

    The fields are a run longer than needed, so that a run may begin at any row.
    """

    x: ti.Field
    y: ti.Field
    z: ti.Field
    """Coordinates [m], shape (rows + RUN,)."""
    cell_start: ti.Field
    """First row of each cell in use, shape (cells in use + 1,)."""

    @classmethod
    def allocate(cls, rows: int, cells: int) -> "Points":
        """Fields for a number of points in a number of cells."""
        x, y, z = (ti.field(float, rows + RUN) for _ in range(3))
        return cls(x, y, z, ti.field(int, cells + 1))
