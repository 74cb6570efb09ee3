"""Neighbours: a cell grid, particles sorted by cell, and lists with a skin.

Blood is sorted by cell and, inside a cell, by identity, so that sums run in one order and two
runs agree bitwise.  Lists hold what lies within R + skin when they are built and stay valid
until some particle has moved half the skin.  Proxies are sorted once: where they move, by the
middle of their way, and the cells are wider by half of it.
"""

import math
from dataclasses import dataclass

import numpy as np
import taichi as ti

from taichi_sph.errors import RunError
from taichi_sph.particles.grid import RUN, Grid, Points
from taichi_sph.particles.particles import Particles
from taichi_sph.particles.wall import Wall, move_wall, place_proxies
from taichi_sph.runtime import float_dtype

ROW_MULTIPLE = 8
"""Slots of a list come in so many, that rows begin at addresses that fit the CPU's vectors."""


def list_capacity(expected: float) -> int:
    """Slots a list gets for an expected number of entries; half as many again, and sixteen."""
    return ROW_MULTIPLE * math.ceil((1.5 * expected + 16) / ROW_MULTIPLE)


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
    """Row that each row of the sorted blood comes from, shape (capacity,)."""
    parallel_scan: ti.algorithms.PrefixSumExecutor | None = None
    """Running sum over cells on CUDA, the only place where Taichi has a parallel one."""
    builds: int = 0
    """How often the lists were built."""
    stale: bool = True
    """Whether the lists must be built before the next step: who changes blood or wall sets it, and
    `note_drift` where something has moved too far."""
    wall_moved: float = 0.0
    """How far a proxy may have moved since the lists were built [m]."""

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
            parallel_scan=(
                ti.algorithms.PrefixSumExecutor(cells + 1) if ti.cfg.arch == ti.cuda else None
            ),
        )

    def sort_wall(self, wall: Wall) -> None:
        """Put the proxies in the order of the grid; again only when the wall changes."""
        self.stale = True
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
        order = wall.order = np.argsort(cell, kind="stable")
        # One kernel for all: each field's own would cost some 0.05 s at start.
        place_proxies(wall, proxies, *(a[order] for a in given))
        move_wall(wall, proxies, wall.displacement_factor, wall.rate)
        start = np.searchsorted(cell[order], np.arange(cells + 1))
        proxies.cell_start.from_numpy(start.astype(np.int32))

    def note_drift(self, blood_moved: float, wall_moved: float) -> None:
        """Note a step's motion; the lists are stale once something may be near unlisted.

        Args:
            blood_moved: farthest that blood is from where the lists were built [m].
            wall_moved: how far a proxy may have moved in the step [m].
        """
        self.wall_moved += wall_moved
        # Two particles, or one and a proxy, may have come nearer to each other by more.
        self.stale = blood_moved + max(blood_moved, self.wall_moved) > self.skin

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
        self.stale, self.wall_moved = False, 0.0
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


@ti.func
def cell_in_use(nb: ti.template(), x):
    """Cell of a position among those in use."""
    return ti.min(nb.rank[nb.grid.index(nb.grid.cell_of(x))], nb.built.cell_start.shape[0] - 2)


@ti.kernel
def count_cells(p: ti.template(), nb: ti.template()):
    """Histogram over cells, shifted by one, without removed particles.

    Reads: position, identity.  Writes: nb.built.cell_start, nb.blood_count.
    """
    for c in nb.built.cell_start:
        nb.built.cell_start[c] = 0
    for i in range(p.count[None]):
        nb.blood_count[i] = 0
        if p.identity[i] >= 0:
            ti.atomic_add(nb.built.cell_start[cell_in_use(nb, p.position[i]) + 1], 1)


@ti.kernel
def scan_serial(a: ti.template()):
    """Running sum in place.  Writes: a."""
    ti.loop_config(serialize=True)
    total = 0
    for k in range(a.shape[0]):
        total += a[k]
        a[k] = total


@ti.kernel
def sort_rows(p: ti.template(), nb: ti.template()):
    """Rows by cell, and by identity inside a cell (insertion sort).

    Reads: position, identity.  Writes: nb.order, p.count; counts in nb.blood_count.
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
    """Move the rows of all quantities into the order of the grid.  Writes: nb.built too."""
    for i in range(p.count[None]):
        row = nb.order[i]
        x = p.position[row]
        nb.built.x[i] = x[0]
        nb.built.y[i] = x[1]
        nb.built.z[i] = x[2]
        for values, scratch in ti.static(zip(p.sorted_fields, p.scratch, strict=True)):
            scratch[i] = values[row]
    for i in range(p.count[None]):
        p.position[i] = ti.Vector([nb.built.x[i], nb.built.y[i], nb.built.z[i]])
        for values, scratch in ti.static(zip(p.sorted_fields, p.scratch, strict=True)):
            values[i] = scratch[i]


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


@ti.func
def list_periodic(p: ti.template(), w: ti.template(), nb: ti.template(), i, x_i, c, reach2):
    """Fill the lists of row i, in cell c of a grid with periodic axes; their lengths."""
    blood = 0
    walls = 0
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
            first = nb.rank[nb.grid.index(d)]
            last = nb.rank[nb.grid.index(d) + 1]
            for j in range(nb.built.cell_start[first], nb.built.cell_start[last]):
                if nb.grid.separation(x_i, p.position[j]).norm_sqr() < reach2 and j != i:
                    if blood < nb.blood_capacity:
                        nb.blood_index[i, blood] = j
                    blood += 1
            for k in range(nb.proxies.cell_start[first], nb.proxies.cell_start[last]):
                if nb.grid.separation(x_i, w.position[k]).norm_sqr() < reach2:
                    if walls < nb.wall_capacity:
                        nb.wall_index[i, walls] = k
                    walls += 1
    return ti.Vector([blood, walls])


@ti.func
def list_bounded(nb: ti.template(), i, x_i, c, reach2):
    """Fill the lists of row i, in cell c of a grid without periodic axes; their lengths."""
    blood = 0
    walls = 0
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
            first = nb.rank[row + z0]
            last = nb.rank[row + z1]
            j = nb.built.cell_start[first]
            last_j = nb.built.cell_start[last]
            while j < last_j:
                bits = near_bits(nb.built, x_i, j, last_j, reach2)
                if j <= i and i < j + RUN:
                    bits &= ~(1 << (i - j))  # not itself
                blood = append(bits, j, i, nb.blood_capacity, blood, nb.blood_index)
                j += RUN
            k = nb.proxies.cell_start[first]
            last_k = nb.proxies.cell_start[last]
            while k < last_k:
                bits = near_bits(nb.proxies, x_i, k, last_k, reach2)
                walls = append(bits, k, i, nb.wall_capacity, walls, nb.wall_index)
                k += RUN
    return ti.Vector([blood, walls])


@ti.func
def list_tool(w: ti.template(), nb: ti.template(), i, x_i, walls, reach2):
    """Add the tool's proxies to the wall list of row i, which has a length; its new length."""
    ball = ti.Vector([nb.tool_ball[0], nb.tool_ball[1], nb.tool_ball[2]])
    far = nb.tool_ball[3] + ti.static(nb.support_radius + nb.skin)
    if nb.tool_ball[3] > 0.0 and (x_i - ball).norm_sqr() < far * far:
        k = 0
        while k < ti.static(w.tool):
            bits = near_bits(nb.tool, x_i, k, ti.static(w.tool), reach2)
            walls = append(bits, w.count + k, i, nb.wall_capacity, walls, nb.wall_index)
            k += RUN
    return walls


@ti.kernel
def build_lists(p: ti.template(), w: ti.template(), nb: ti.template()) -> ti.math.ivec2:
    """Lists of blood and proxies within R + skin; returns the longest of each.

    Entries beyond a list's capacity are counted, not stored: the caller refuses them.
    Reads: position, wall, nb.built, nb.proxies, nb.tool.  Writes: the lists.
    """
    longest_blood = 0
    longest_wall = 0
    for i in range(p.count[None]):
        x_i = p.position[i]
        c = nb.grid.cell_of(x_i)
        reach2 = ti.static((nb.support_radius + nb.skin) ** 2)
        length = ti.Vector([0, 0])
        if ti.static(nb.grid.periodic):
            length = list_periodic(p, w, nb, i, x_i, c, reach2)
        else:
            length = list_bounded(nb, i, x_i, c, reach2)
        blood = length[0]
        walls = length[1]
        if ti.static(w.tool > 0):
            walls = list_tool(w, nb, i, x_i, walls, reach2)
        nb.blood_count[i] = ti.min(blood, nb.blood_capacity)
        nb.wall_count[i] = ti.min(walls, nb.wall_capacity)
        ti.atomic_max(longest_blood, blood)
        ti.atomic_max(longest_wall, walls)
    return ti.Vector([longest_blood, longest_wall])
