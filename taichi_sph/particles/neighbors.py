"""Neighbours: a cell grid, particles sorted by cell, and lists with a skin.

Blood is sorted by cell and, inside a cell, by identity, so that sums run in one order and two
runs agree bitwise.  Lists hold what lies within R + skin when they are built and stay valid
until some particle has moved half the skin.  Proxies are sorted once: where they pulse, by the
middle of their way, and the cells are wider by half of it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import taichi as ti

from taichi_sph.errors import RunError
from taichi_sph.particles.particles import Particles
from taichi_sph.particles.wall import Wall
from taichi_sph.runtime import float_dtype

ROW_MULTIPLE = 8

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


def list_capacity(expected: float) -> int:
    """Slots a list gets for an expected number of entries; half as many again, and sixteen."""
    return ROW_MULTIPLE * math.ceil((1.5 * expected + 16) / ROW_MULTIPLE)


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


@dataclass(eq=False)
class Neighbors:
    """Neighbour lists of the blood: blood_index[i, :blood_count[i]], likewise for proxies.

    A list holds candidates up to R + skin; whoever sums tests |r_ij| < R (a kernel that is zero
    from R on does so by itself).
    """

    grid: Grid
    support_radius: float
    """R [m]."""
    skin: float
    """How much farther than R the lists reach [m]."""
    blood_capacity: int
    wall_capacity: int
    blood_count: ti.Field
    blood_index: ti.Field
    wall_count: ti.Field
    wall_index: ti.Field
    rank: ti.Field
    """How many of the cells in use come before each cell, shape (cells + 1,)."""
    built: Points
    """Blood where it was when the lists were built."""
    proxies: Points
    tool: Points
    """Proxies of a tool, in no order: they are few and move."""
    tool_ball: ti.Field
    """Centre and radius of a ball that holds them [m], shape (4,); the radius 0 where none do."""
    order: ti.Field
    row_velocity: ti.MatrixField
    row_acceleration: ti.MatrixField
    row_identity: ti.Field
    parallel_scan: ti.algorithms.PrefixSumExecutor | None = None
    """Running sum over cells on CUDA, the only place where Taichi has a parallel one."""
    builds: int = 0
    """How often the lists were built."""

    @classmethod
    def allocate(
        cls, grid: Grid, support_radius: float, skin: float, capacity: int,
        spacing: float, wall: Wall, used: np.ndarray | None = None,
    ) -> "Neighbors":  # fmt: skip
        """Make the fields for `capacity` particles of a spacing [m] beside a wall.

        `used` says which cells blood can be in, all if None.  A stray particle elsewhere counts as
        in the next cell in use: it may miss others that strayed with it, and nothing else.
        """
        used = np.ones(grid.cells, bool) if used is None else used
        rank = ti.field(int, grid.cells + 1)
        rank.from_numpy(np.concatenate([[0], np.cumsum(used)]).astype(np.int32))
        cells = int(used.sum())
        reach = support_radius + skin
        blood = list_capacity(4.0 / 3.0 * math.pi * (reach / spacing) ** 3)
        # In a narrow tube or a corner twice a plane wall's proxies lie within reach.
        walls = list_capacity(
            (2.0 if wall.tool == 0 else 4.0) * math.pi * (reach / wall.spacing) ** 2
        )
        return cls(
            grid=grid,
            support_radius=support_radius,
            skin=skin,
            blood_capacity=blood,
            wall_capacity=walls,
            blood_count=ti.field(int, capacity),
            blood_index=ti.field(int, (capacity, blood)),
            wall_count=ti.field(int, capacity),
            wall_index=ti.field(int, (capacity, walls)),
            rank=rank,
            built=Points.allocate(capacity, cells),
            proxies=Points.allocate(wall.count, cells),
            tool=Points.allocate(wall.tool, 1),
            tool_ball=ti.field(float, 4),
            order=ti.field(int, capacity),
            row_velocity=ti.Vector.field(3, float, capacity),
            row_acceleration=ti.Vector.field(3, float, capacity),
            row_identity=ti.field(int, capacity),
            parallel_scan=(
                ti.algorithms.PrefixSumExecutor(cells + 1) if ti.cfg.arch == ti.cuda else None
            ),
        )

    def sort_wall(self, wall: Wall) -> None:
        """Put the proxies in the order of the grid; again only when the wall changes."""
        proxies = self.proxies
        proxies.cell_start.fill(0)
        if wall.count == 0:
            return
        given = [np.asarray(a, dtype=float_dtype()) for a in wall.given]
        x = np.asarray(wall.given.at(0.5), dtype=float_dtype())
        c = np.floor((x - np.asarray(self.grid.lower)) / np.asarray(self.grid.cell)).astype(int)
        c = np.clip(c, 0, np.asarray(self.grid.shape) - 1)
        cell = (c[:, 0] * self.grid.shape[1] + c[:, 1]) * self.grid.shape[2] + c[:, 2]
        cells = proxies.cell_start.shape[0] - 1
        cell = np.minimum(self.rank.to_numpy()[cell], cells - 1)
        order = np.argsort(cell, kind="stable")
        # One kernel for all: each field's own would cost some 0.05 s at start.
        place_proxies(wall, proxies, *(a[order] for a in given))
        self.move_wall(wall, wall.level, wall.rate)
        start = np.searchsorted(cell[order], np.arange(cells + 1))
        proxies.cell_start.from_numpy(start.astype(np.int32))

    def move_wall(self, wall: Wall, level: float, rate: float) -> None:
        """Put a wall that pulses at a level, 0 narrow to 1 wide, moving at a rate [1/s]."""
        wall.level, wall.rate = level, rate
        if wall.pulses:
            move_proxies(wall, self.proxies, len(wall.given.position), level, rate)

    def build(self, particles: Particles, wall: Wall) -> None:
        """Drop removed particles (identity < 0), sort the rest and build the lists anew.

        Raises:
            RunError: a particle has more neighbours than a list holds.
        """
        count_cells(particles, self)
        if self.parallel_scan is None:
            scan_serial(self.built.cell_start)
        else:
            self.parallel_scan.run(self.built.cell_start)
        sort_rows(particles, self)
        reorder(particles, self)
        longest = build_lists(particles, wall, self)
        self.builds += 1
        for kind, found, capacity in (
            ("blood", int(longest[0]), self.blood_capacity),
            ("wall", int(longest[1]), self.wall_capacity),
        ):
            if found > capacity:
                raise RunError(
                    f"a blood particle has {found} {kind} neighbours within "
                    f"{self.support_radius + self.skin:.3g} m, the list holds {capacity}: "
                    "particles have clumped, so the step was too long or the spacing too small"
                )


@ti.kernel
def place_proxies(
    w: ti.template(),
    points: ti.template(),
    position: ti.types.ndarray(ndim=2),
    normal: ti.types.ndarray(ndim=2),
    volume: ti.types.ndarray(ndim=1),
    swing: ti.types.ndarray(ndim=1),
    wide_volume: ti.types.ndarray(ndim=1),
):
    """Proxies in the order of the grid.  Writes: the wall's fields, points."""
    for k in range(volume.shape[0]):
        for a in ti.static(range(3)):
            w.position[k][a] = position[k, a]
            w.normal[k][a] = normal[k, a]
        w.volume[k] = volume[k]
        if ti.static(w.pulses):
            w.narrow[k] = w.position[k]
            w.swing[k] = swing[k] * w.normal[k]
            w.narrow_volume[k] = volume[k]
            w.wide_volume[k] = wide_volume[k]
        points.x[k] = position[k, 0]
        points.y[k] = position[k, 1]
        points.z[k] = position[k, 2]


@ti.kernel
def move_proxies(w: ti.template(), points: ti.template(), count: int, level: float, rate: float):
    """x_k = narrow + level swing, v_k = rate swing, V_k (Eq. 3) on a line between its two ends.

    The normals are those of the wall at its narrowest.  Writes: position, velocity, volume, points.
    """
    for k in range(count):
        x = w.narrow[k] + level * w.swing[k]
        w.position[k] = x
        w.velocity[k] = rate * w.swing[k]
        w.volume[k] = w.narrow_volume[k] + level * (w.wide_volume[k] - w.narrow_volume[k])
        points.x[k] = x[0]
        points.y[k] = x[1]
        points.z[k] = x[2]


@ti.func
def cell_in_use(nb: ti.template(), x):
    """Cell of a position among those in use."""
    return ti.min(nb.rank[nb.grid.index(nb.grid.cell_of(x))], nb.built.cell_start.shape[0] - 2)


@ti.kernel
def count_cells(p: ti.template(), nb: ti.template()):
    """Histogram over cells, shifted by one, without removed particles.  Writes: cell_start."""
    for c in nb.built.cell_start:
        nb.built.cell_start[c] = 0
    for i in range(p.count[None]):
        nb.blood_count[i] = 0
        if p.identity[i] >= 0:
            ti.atomic_add(nb.built.cell_start[cell_in_use(nb, p.position[i]) + 1], 1)


@ti.kernel
def scan_serial(a: ti.template()):
    """Running sum in place."""
    ti.loop_config(serialize=True)
    total = 0
    for k in range(a.shape[0]):
        total += a[k]
        a[k] = total


@ti.kernel
def sort_rows(p: ti.template(), nb: ti.template()):
    """Rows by cell, and by identity inside a cell (insertion sort).

    Writes: nb.order, p.count; counts in nb.blood_count.
    """
    for i in range(p.count[None]):
        if p.identity[i] >= 0:
            first = nb.built.cell_start[cell_in_use(nb, p.position[i])]
            # A particle's slot is taken on the counter of the cell's first row.
            nb.order[first + ti.atomic_add(nb.blood_count[first], 1)] = i
    for c in range(nb.built.cell_start.shape[0] - 1):
        first = nb.built.cell_start[c]
        last = nb.built.cell_start[c + 1]
        for k in range(first + 1, last):
            row = nb.order[k]
            name = p.identity[row]
            m = k - 1
            while m >= first and p.identity[nb.order[m]] > name:
                nb.order[m + 1] = nb.order[m]
                m -= 1
            nb.order[m + 1] = row
    p.count[None] = nb.built.cell_start[nb.built.cell_start.shape[0] - 1]


@ti.kernel
def reorder(p: ti.template(), nb: ti.template()):
    """Move the rows of the state into the order of the grid.  Writes: nb.built too."""
    for i in range(p.count[None]):
        row = nb.order[i]
        x = p.position[row]
        nb.built.x[i] = x[0]
        nb.built.y[i] = x[1]
        nb.built.z[i] = x[2]
        nb.row_velocity[i] = p.velocity[row]
        nb.row_acceleration[i] = p.acceleration[row]
        nb.row_identity[i] = p.identity[row]
    for i in range(p.count[None]):
        p.position[i] = ti.Vector([nb.built.x[i], nb.built.y[i], nb.built.z[i]])
        p.velocity[i] = nb.row_velocity[i]
        p.acceleration[i] = nb.row_acceleration[i]
        p.identity[i] = nb.row_identity[i]


@ti.func
def near_bits(points: ti.template(), x, first, last, reach2):
    """Bit k says that row first + k < last is nearer to x than the root of reach2.

    The loop has no branch, no store and a fixed length: the CPU tests eight or sixteen at a time.
    """
    bits = 0
    for k in range(RUN):
        dx = x[0] - points.x[first + k]
        dy = x[1] - points.y[first + k]
        dz = x[2] - points.z[first + k]
        bits |= ti.select(dx * dx + dy * dy + dz * dz < reach2, 1 << k, 0)
    beyond = ti.max(0, RUN - (last - first))
    return bits & ti.bit_shr(-1, beyond)


@ti.func
def append(bits, first, row, length, count, index: ti.template()):
    """Add the rows of the bits to list `row`, as far as it has room; the new count."""
    while bits != 0:
        lowest = bits & -bits
        if count < length:
            # The zeros below the lowest bit; counting those above goes wrong on Metal for bit 31.
            index[row, count] = first + ti.math.popcnt(lowest - 1)
        count += 1
        bits ^= lowest
    return count


@ti.kernel
def build_lists(p: ti.template(), w: ti.template(), nb: ti.template()) -> ti.math.ivec2:
    """Lists of blood and proxies within R + skin; returns the longest of each.

    Entries beyond a list's capacity are counted, not stored: the caller refuses them.
    """
    longest_blood = 0
    longest_wall = 0
    for i in range(p.count[None]):
        x_i = p.position[i]
        c = nb.grid.cell_of(x_i)
        reach2 = ti.static((nb.support_radius + nb.skin) ** 2)
        blood = 0
        walls = 0
        if ti.static(nb.grid.periodic):
            for dx, dy, dz in ti.ndrange(
                (-nb.grid.reach[0], nb.grid.reach[0] + 1),
                (-nb.grid.reach[1], nb.grid.reach[1] + 1),
                (-nb.grid.reach[2], nb.grid.reach[2] + 1),
            ):
                d = c + ti.Vector([dx, dy, dz])
                inside = 1
                for a in ti.static(range(3)):
                    if ti.static(nb.grid.period[a] > 0.0):
                        d[a] = (d[a] + nb.grid.shape[a]) % nb.grid.shape[a]
                    elif d[a] < 0 or d[a] >= nb.grid.shape[a]:
                        inside = 0
                if inside == 1:
                    here = nb.rank[nb.grid.index(d)]
                    there = nb.rank[nb.grid.index(d) + 1]
                    for j in range(nb.built.cell_start[here], nb.built.cell_start[there]):
                        if nb.grid.separation(x_i, p.position[j]).norm_sqr() < reach2 and j != i:
                            if blood < nb.blood_capacity:
                                nb.blood_index[i, blood] = j
                            blood += 1
                    for k in range(nb.proxies.cell_start[here], nb.proxies.cell_start[there]):
                        if nb.grid.separation(x_i, w.position[k]).norm_sqr() < reach2:
                            if walls < nb.wall_capacity:
                                nb.wall_index[i, walls] = k
                            walls += 1
        else:
            # Cells that follow along z are one run of rows.
            z0 = ti.max(c[2] - nb.grid.reach[2], 0)
            z1 = ti.min(c[2] + nb.grid.reach[2], nb.grid.shape[2] - 1) + 1
            for cx in range(
                ti.max(c[0] - nb.grid.reach[0], 0),
                ti.min(c[0] + nb.grid.reach[0], nb.grid.shape[0] - 1) + 1,
            ):
                for cy in range(
                    ti.max(c[1] - nb.grid.reach[1], 0),
                    ti.min(c[1] + nb.grid.reach[1], nb.grid.shape[1] - 1) + 1,
                ):
                    row = (cx * nb.grid.shape[1] + cy) * nb.grid.shape[2]
                    here = nb.rank[row + z0]
                    there = nb.rank[row + z1]
                    j = nb.built.cell_start[here]
                    last_j = nb.built.cell_start[there]
                    while j < last_j:
                        bits = near_bits(nb.built, x_i, j, last_j, reach2)
                        if j <= i and i < j + RUN:
                            bits &= ~(1 << (i - j))  # not itself
                        blood = append(bits, j, i, nb.blood_capacity, blood, nb.blood_index)
                        j += RUN
                    k = nb.proxies.cell_start[here]
                    last_k = nb.proxies.cell_start[there]
                    while k < last_k:
                        bits = near_bits(nb.proxies, x_i, k, last_k, reach2)
                        walls = append(bits, k, i, nb.wall_capacity, walls, nb.wall_index)
                        k += RUN
        if ti.static(w.tool > 0):
            ball = ti.Vector([nb.tool_ball[0], nb.tool_ball[1], nb.tool_ball[2]])
            far = nb.tool_ball[3] + ti.static(nb.support_radius + nb.skin)
            if nb.tool_ball[3] > 0.0 and (x_i - ball).norm_sqr() < far * far:
                k = 0
                while k < ti.static(w.tool):
                    bits = near_bits(nb.tool, x_i, k, ti.static(w.tool), reach2)
                    walls = append(bits, w.count + k, i, nb.wall_capacity, walls, nb.wall_index)
                    k += RUN
        nb.blood_count[i] = ti.min(blood, nb.blood_capacity)
        nb.wall_count[i] = ti.min(walls, nb.wall_capacity)
        ti.atomic_max(longest_blood, blood)
        ti.atomic_max(longest_wall, walls)
    return ti.Vector([longest_blood, longest_wall])
