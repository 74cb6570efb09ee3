"""Tracer: dye and age, passive scalars that travel with the blood and act on nothing.

Dye is a concentration between 0 and 1, as of a contrast medium in an angiography.  It is set within
a ball, or for all blood that comes in through a driven opening from now on.

Age is the time that blood has been in the vessel: since it came in through a driven opening's
plane, or since the start for blood that was there.  Its mean over what leaves is the residence
time, which in a steady flow is V/Q (Danckwerts 1953, doi:10.1016/0009-2509(53)80001-1).  It grows
when the lists are built, every few steps: it is that much behind.

Particles exchange nothing: diffusion is left out.  Of molecules in water it is some 1e-9 m^2/s
(Cussler, Diffusion, 2009), less than 0.1 mm in a second, and no scene resolves that.
"""

from typing import Any

import numpy as np
import taichi as ti

from taichi_sph.boundary.boundary import BloodFlow, Boundary
from taichi_sph.boundary.inflow import BufferZones
from taichi_sph.boundary.outlets import Outlets
from taichi_sph.errors import InputError
from taichi_sph.fluid.model import AccelerationModel
from taichi_sph.geometry.mesh import Floats
from taichi_sph.particles.particles import Quantity
from taichi_sph.runtime import float_dtype, has_wide_atomics

DYE = Quantity("dye")
"""Concentration of the dye over that of the medium as injected [-]."""
AGE = Quantity("age")
"""Time in the vessel [s]."""

AGE_SCALE = float(1 << 20)
"""Ages are summed as whole multiples of 1/AGE_SCALE s: the order then does not matter."""

UNTOUCHED = -1.0
"""Concentration of an inflow that nobody has said anything about: blood keeps what it has."""


class Tracer(Boundary):
    """Dye in the blood, and its age."""

    name = "tracer"

    def __init__(self, blood: BloodFlow, inflow: BufferZones, outlets: Outlets):
        """Blood without dye; it comes in as `inflow` says, and leaves by `outlets`."""
        self.blood = blood
        fields = dict(zip(blood.particles.names, blood.particles.fields, strict=True))
        self.dye: ti.Field = fields[DYE.name]
        """Concentration [-], shape (capacity,), in the order of the particles."""
        self.age: ti.Field = fields[AGE.name]
        """[s], likewise."""
        self._aged_until = blood.time
        """Time that the ages are of [s]."""
        # Metal has no sums of 64-bit integers: there the last digits may differ.
        self.age_sum = ti.field(ti.i64 if has_wide_atomics() else float)
        """Sum of the ages of what has left, by place as the counts of `Outlets` [1/AGE_SCALE s]."""
        # In a tree of its own: among 32-bit fields it overlaps them on Vulkan.
        alone = ti.FieldsBuilder()
        alone.dense(ti.i, outlets.count + 2).place(self.age_sum)
        alone.finalize()
        self._outlets = outlets
        self._inflow = inflow
        self._inlet = np.full(max(1, len(inflow.openings)), UNTOUCHED, float_dtype())
        """Concentration of what comes in through each driven opening."""

    @property
    def in_use(self) -> bool:
        """Whether blood comes in with a concentration that somebody has set."""
        return bool((self._inlet != UNTOUCHED).any())

    def mark_ball(self, centre: Floats, radius: float, concentration: float = 1.0) -> int:
        """Set the concentration of the blood within a radius of a point.

        Args:
            centre: [m], (3,).
            radius: [m].
            concentration: of the dye, 0 to 1.

        Returns:
            how many particles were marked.

        Raises:
            InputError: no blood is there, or the concentration is none.
        """
        _require_concentration(concentration)
        x, y, z = map(float, centre)
        marked = int(mark_ball(self.blood.particles, x, y, z, radius, concentration))
        if marked == 0:
            raise InputError(
                f"dye: no blood is within {radius:.3g} m of ({x:.4g}, {y:.4g}, {z:.4g}) m; "
                "allowed: a place in the blood"
            )
        return marked

    def mark_inflow(self, opening: str, concentration: float = 1.0) -> None:
        """Set the concentration of all that comes in through a driven opening from now on.

        Raises:
            InputError: nothing drives that opening, or the concentration is none.
        """
        _require_concentration(concentration)
        names = [driven.opening.name for driven in self._inflow.openings]
        if opening not in names:
            allowed = ", ".join(names) or "none"
            raise InputError(f"dye: no blood comes in through {opening!r}; driven: {allowed}")
        self._inlet[names.index(opening)] = concentration
        self._mark_buffers()

    def mean_age(self) -> Floats:
        """Mean age of all that has left by each place [s]; NaN where nothing has, (count + 2,)."""
        left = self._outlets.outflow_counts()
        total = self.age_sum.to_numpy() / AGE_SCALE
        return np.where(left > 0, total / np.maximum(left, 1), np.nan)

    def before_lists(self) -> None:
        """Mark the blood in the buffers, what was just added with it, and let blood age."""
        self._mark_buffers()
        elapsed, self._aged_until = self.blood.time - self._aged_until, self.blood.time
        add_age(self.blood.particles, self._inflow.regions, self.age_sum, elapsed)

    def _mark_buffers(self) -> None:
        if self.in_use:
            mark_buffers(self.blood.particles, self._inflow.regions, self._inlet)

    def compile_kernels(self, model: AccelerationModel) -> None:
        """Mark nothing, and let no time pass."""
        add_age(self.blood.particles, self._inflow.regions, self.age_sum, 0.0)
        mark_ball(self.blood.particles, 0.0, 0.0, 0.0, 0.0, 0.0)
        mark_buffers(
            self.blood.particles, self._inflow.regions, np.full_like(self._inlet, UNTOUCHED)
        )

    def reset(self) -> None:
        """No dye comes in, nothing has left; the blood that is put back has neither dye nor age."""
        self._inlet[:] = UNTOUCHED
        self._aged_until = self.blood.time
        self.age_sum.fill(0)

    def save_state(self) -> dict[str, Any]:
        """What comes in and what has left; the particles' own are saved with them."""
        return {
            "inlet": self._inlet.tolist(),
            "aged_until": self._aged_until,
            "age_sum": self.age_sum.to_numpy(),
        }

    def load_state(self, saved: dict[str, Any]) -> None:
        """Go on from a saved state; of one without ages blood ages from its time on."""
        self.reset()
        self._inlet[:] = saved["inlet"]
        if "aged_until" in saved:
            self._aged_until = saved["aged_until"]
            self.age_sum.from_numpy(np.asarray(saved["age_sum"]))


def _require_concentration(concentration: float) -> None:
    if not 0.0 <= concentration <= 1.0:
        raise InputError(f"dye: a concentration of {concentration:g}; allowed: 0 to 1")


@ti.kernel
def mark_ball(
    p: ti.template(), x: float, y: float, z: float, radius: float, concentration: float
) -> int:
    """Set the dye within a radius of a point; returns of how many.  Writes: dye."""
    marked = 0
    for i in range(p.count[None]):
        if p.identity[i] >= 0 and (p.position[i] - ti.Vector([x, y, z])).norm() < radius:
            p.dye[i] = concentration
            marked += 1
    return marked


@ti.kernel
def mark_buffers(p: ti.template(), regions: ti.template(), inlet: ti.types.ndarray(ndim=1)):
    """Set the dye of blood in buffers whose concentration is not UNTOUCHED.  Writes: dye."""
    for i in range(p.count[None]):
        k = regions.buffer_at(p.position[i])
        # One after the other: there is no inlet[-1].
        if k >= 0:
            c = inlet[k]
            if c >= 0.0:
                p.dye[i] = c


@ti.kernel
def add_age(p: ti.template(), regions: ti.template(), age_sum: ti.template(), elapsed: float):
    """Let blood in the vessel age, and add up the ages of what is marked as gone.

    Reads: position, identity.  Writes: age, age_sum.
    """
    for i in range(p.count[None]):
        if regions.buffer_at(p.position[i]) < 0:
            p.age[i] += elapsed
        if p.identity[i] < 0:
            place = -2 - p.identity[i]
            ti.atomic_add(age_sum[place], ti.cast(p.age[i] * AGE_SCALE, age_sum.dtype))
