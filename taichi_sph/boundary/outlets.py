"""Exits: where blood leaves for good, and the account of what has left.

Free openings, the far ends of plugs and wounds are all alike: blood that is beyond a plane, near a
line in it, has left by that exit.  Suction takes what is near a point, at a rate.
"""

import numpy as np
import taichi as ti

from taichi_sph.geometry.mesh import Floats
from taichi_sph.runtime import float_dtype

OUT_OF_BOX, SUCTION = 0, 1
"""First places of the account: particles that left the grid's box, and those sucked away; each
exit's follows.  What has left by place s has the identity -2 - s."""

MOST_DROPS = 4096
"""Drops that are remembered of blood that has left through exits told to, the latest ones."""


class Outlets:
    """The planes, and how many particles have left by each."""

    def __init__(self, count: int):
        """Make the fields for `count` exits, all shut."""
        self.count = count
        rows = max(1, count)
        self.begin = ti.Vector.field(3, float, rows)
        """One end of the line [m]."""
        self.end = ti.Vector.field(3, float, rows)
        """The other; the same where the exit is round [m]."""
        self.normal = ti.Vector.field(3, float, rows)
        """Unit normals, out."""
        self.reach = ti.field(float, rows)
        """Blood farther than this from the line has not left by it [m]; 0 where shut."""
        self.track_droplets = ti.field(int, rows)
        """Whether what leaves is remembered as drops."""
        self.used = ti.field(int, ())
        """No exit from this one on has ever been open."""
        self.removed = ti.field(int, rows + 2)
        self.drop_count = ti.field(int, ())
        self.drop_position = ti.Vector.field(3, float, MOST_DROPS)
        self.drop_velocity = ti.Vector.field(3, float, MOST_DROPS)
        self.drop_time = ti.field(float, MOST_DROPS)

    def open(
        self,
        k: int,
        begin: Floats,
        end: Floats,
        normal: Floats,
        reach: float,
        track_droplets: bool = False,
    ) -> None:
        """Let blood leave by exit k; the meaning of the rest is that of the fields."""
        self.begin[k], self.end[k], self.normal[k] = begin, end, normal
        self.reach[k], self.track_droplets[k] = reach, int(track_droplets)
        self.used[None] = max(self.used[None], k + 1)

    def shut(self, k: int) -> None:
        """Let no more blood leave by exit k."""
        self.reach[k] = 0.0

    def mark(self, particles: "ti.template", grid: "ti.template", time: float) -> None:
        """Mark what has left, at a time [s]; the next build of the lists drops it."""
        mark_removed(particles, grid, self, time)

    def take(self, particles: "ti.template", rows: np.ndarray, k: int) -> None:
        """Have the live particles of these rows, bool (n,), leave by exit k."""
        take_rows(particles, self, np.ascontiguousarray(rows, np.int32), k)

    def account(self) -> np.ndarray:
        """Particles that have left by each place, (count + 2,)."""
        return np.asarray(self.removed.to_numpy()[: self.count + 2])

    def drops(self, time: float, gravity: Floats, longest: float) -> Floats:
        """Where drops are now, falling freely since they left [m], (n, 3).

        Args:
            time: now [s].
            gravity: [m/s^2], (3,).
            longest: drops are forgotten after this time [s].
        """
        n = min(int(self.drop_count[None]), MOST_DROPS)
        if n == 0:
            return np.zeros((0, 3), float_dtype())
        age = time - self.drop_time.to_numpy()[:n]
        recent = (age >= 0.0) & (age < longest)
        age = age[recent, None]
        x, v = (f.to_numpy()[:n][recent] for f in (self.drop_position, self.drop_velocity))
        return np.asarray(x + v * age + 0.5 * np.asarray(gravity) * age**2, float_dtype())


@ti.kernel
def mark_removed(p: ti.template(), grid: ti.template(), exits: ti.template(), time: float):
    """Mark blood beyond an exit, or out of the box.  Writes: identity, removed, drops."""
    for i in range(p.count[None]):
        x = p.position[i]
        for k in range(exits.used[None]):
            if p.identity[i] >= 0 and exits.reach[k] > 0.0:
                r = x - exits.begin[k]
                line = exits.end[k] - exits.begin[k]
                share = ti.max(0.0, ti.min(1.0, r.dot(line) / ti.max(line.norm_sqr(), 1e-20)))
                if r.dot(exits.normal[k]) > 0.0 and (r - share * line).norm() < exits.reach[k]:
                    p.identity[i] = -4 - k
                    ti.atomic_add(exits.removed[2 + k], 1)
                    if exits.track_droplets[k] == 1:
                        m = ti.atomic_add(exits.drop_count[None], 1) % MOST_DROPS
                        exits.drop_position[m] = x
                        exits.drop_velocity[m] = p.velocity[i]
                        exits.drop_time[m] = time
        if p.identity[i] >= 0:
            for a in ti.static(range(3)):
                upper = grid.lower[a] + grid.cell[a] * grid.shape[a]
                outside = x[a] < grid.lower[a] or x[a] > upper
                if outside and p.identity[i] >= 0:
                    p.identity[i] = -2 - OUT_OF_BOX
                    ti.atomic_add(exits.removed[OUT_OF_BOX], 1)


@ti.kernel
def take_rows(
    p: ti.template(), exits: ti.template(), rows: ti.types.ndarray(dtype=ti.i32, ndim=1), k: int
):
    """Writes: identity, removed."""
    for i in range(rows.shape[0]):
        if rows[i] == 1 and p.identity[i] >= 0:
            p.identity[i] = -4 - k
            ti.atomic_add(exits.removed[2 + k], 1)


@ti.kernel
def suck(p: ti.template(), exits: ti.template(), x: float, y: float, z: float, reach: float,
         most: int) -> int:  # fmt: skip
    """Mark at most so many particles near a point, in the order of the rows; returns how many.

    One after the other, so that which ones go does not depend on threads.
    """
    taken = 0
    ti.loop_config(serialize=True)
    for i in range(p.count[None]):
        near = (p.position[i] - ti.Vector([x, y, z])).norm() < reach
        if taken < most and p.identity[i] >= 0 and near:
            p.identity[i] = -2 - SUCTION
            taken += 1
    exits.removed[SUCTION] += taken
    return taken
