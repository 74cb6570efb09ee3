"""Outlets: where blood leaves for good, and the count of what has left.

Free openings, the far ends of buffer zones and wounds are all alike: blood that is beyond a plane,
near a line in it, has left by that outlet.  Suction takes what is near a point, at a rate.
"""

from typing import Any

import numpy as np
import taichi as ti

from taichi_sph.boundary.boundary import BloodFlow, Boundary
from taichi_sph.errors import InputError
from taichi_sph.geometry.mesh import Floats
from taichi_sph.runtime import float_dtype

OUT_OF_BOX, SUCTION = 0, 1
"""First places of the counts: particles that left the grid's box, and those aspirated; each
outlet's follows.  What has left by place s has the identity -2 - s."""

MOST_DROPLETS = 4096
"""Droplets that are remembered of blood that has left through outlets told to: the latest."""

DROPLET_TIME = 0.3
"""Droplets are shown for this long [s]: they fall 0.4 m."""


class Outlets(Boundary):
    """The planes that blood leaves by, and how many particles have left by each."""

    name = "outlets"

    def __init__(self, blood: BloodFlow, count: int):
        """Make the fields for `count` outlets, all closed."""
        self.blood = blood
        self.count = count
        rows = max(1, count)
        self.begin = ti.Vector.field(3, float, rows)
        """One end of the line [m]."""
        self.end = ti.Vector.field(3, float, rows)
        """The other; the same where the outlet is round [m]."""
        self.normal = ti.Vector.field(3, float, rows)
        """Unit normals, out."""
        self.reach = ti.field(float, rows)
        """Blood farther than this from the line has not left by it [m]; 0 where closed."""
        self.track_droplets = ti.field(int, rows)
        """Whether what leaves is remembered as droplets."""
        self.used = ti.field(int, ())
        """No outlet from this one on has ever been open."""
        self.removed = ti.field(int, rows + 2)
        self.droplet_count = ti.field(int, ())
        self.droplet_position = ti.Vector.field(3, float, MOST_DROPLETS)
        self.droplet_velocity = ti.Vector.field(3, float, MOST_DROPLETS)
        self.droplet_time = ti.field(float, MOST_DROPLETS)

    def open(
        self, k: int, begin: Floats, end: Floats, normal: Floats, reach: float,
        track_droplets: bool = False,
    ) -> None:  # fmt: skip
        """Let blood leave by outlet k; the meaning of the rest is that of the fields."""
        self.begin[k], self.end[k], self.normal[k] = begin, end, normal
        self.reach[k], self.track_droplets[k] = reach, int(track_droplets)
        self.used[None] = max(self.used[None], k + 1)

    def close(self, k: int) -> None:
        """Let no more blood leave by outlet k."""
        self.reach[k] = 0.0

    def mark_outflow(self) -> None:
        """Mark what has left; the next build of the lists drops it."""
        blood = self.blood
        mark_outflow(blood.particles, blood.neighbors.grid, self, blood.time)

    def remove_rows(self, rows: np.ndarray, k: int) -> None:
        """Have the live particles of these rows, bool (n,), leave by outlet k."""
        mark_rows(self.blood.particles, self, np.ascontiguousarray(rows, np.int32), k)

    def outflow_counts(self) -> np.ndarray:
        """Particles that have left by each place, (count + 2,)."""
        return np.asarray(self.removed.to_numpy()[: self.count + 2])

    def droplets(self) -> Floats:
        """Where blood is now that has lately left through wounds, falling freely [m], (n, 3)."""
        n = min(int(self.droplet_count[None]), MOST_DROPLETS)
        if n == 0:
            return np.zeros((0, 3), float_dtype())
        age = self.blood.time - self.droplet_time.to_numpy()[:n]
        recent = (age >= 0.0) & (age < DROPLET_TIME)
        age = age[recent, None]
        x, v = (f.to_numpy()[:n][recent] for f in (self.droplet_position, self.droplet_velocity))
        return np.asarray(
            x + v * age + 0.5 * np.asarray(self.blood.gravity) * age**2, float_dtype()
        )

    def before_lists(self) -> None:
        """Mark what has left by an outlet or out of the box."""
        self.mark_outflow()

    def reset(self) -> None:
        """Nothing has left; which outlets are open is for those who opened them to say."""
        self.removed.fill(0)
        self.droplet_count[None] = 0

    def save_state(self) -> dict[str, Any]:
        """The counts; droplets are for show."""
        return {"removed": self.outflow_counts()}

    def load_state(self, saved: dict[str, Any]) -> None:
        """Counts of before.

        Raises:
            InputError: they are of another number of outlets.
        """
        removed = np.asarray(saved["removed"])
        if removed.shape != (self.count + 2,):
            raise InputError(
                f"a state that counts what has left by {len(removed)} places: the scene has "
                f"{self.count + 2}"
            )
        self.removed.from_numpy(removed)


@ti.kernel
def mark_outflow(p: ti.template(), grid: ti.template(), outlets: ti.template(), time: float):
    """Mark blood beyond an outlet, or out of the box.  Writes: identity, removed, droplets."""
    for i in range(p.count[None]):
        x = p.position[i]
        for k in range(outlets.used[None]):
            if p.identity[i] >= 0 and outlets.reach[k] > 0.0:
                r = x - outlets.begin[k]
                line = outlets.end[k] - outlets.begin[k]
                along = ti.max(0.0, ti.min(1.0, r.dot(line) / ti.max(line.norm_sqr(), 1e-20)))
                if r.dot(outlets.normal[k]) > 0.0 and (r - along * line).norm() < outlets.reach[k]:
                    p.identity[i] = -4 - k
                    ti.atomic_add(outlets.removed[2 + k], 1)
                    if outlets.track_droplets[k] == 1:
                        m = ti.atomic_add(outlets.droplet_count[None], 1) % MOST_DROPLETS
                        outlets.droplet_position[m] = x
                        outlets.droplet_velocity[m] = p.velocity[i]
                        outlets.droplet_time[m] = time
        if p.identity[i] >= 0:
            for a in ti.static(range(3)):
                upper = grid.lower[a] + grid.cell[a] * grid.shape[a]
                outside = x[a] < grid.lower[a] or x[a] > upper
                if outside and p.identity[i] >= 0:
                    p.identity[i] = -2 - OUT_OF_BOX
                    ti.atomic_add(outlets.removed[OUT_OF_BOX], 1)


@ti.kernel
def mark_rows(
    p: ti.template(), outlets: ti.template(), rows: ti.types.ndarray(dtype=ti.i32, ndim=1), k: int
):
    """Mark the rows that hold 1 as gone by outlet k.  Writes: identity, removed."""
    for i in range(rows.shape[0]):
        if rows[i] == 1 and p.identity[i] >= 0:
            p.identity[i] = -4 - k
            ti.atomic_add(outlets.removed[2 + k], 1)
