"""Tracer: a contrast medium, a passive scalar that travels with the blood and acts on nothing.

Each particle has a concentration between 0 and 1, as blood that carries a dye in an angiography.
It is set within a ball, or for all blood that comes in through a driven opening from now on.
Particles exchange nothing: diffusion is left out.  Of molecules in water it is some 1e-9 m^2/s
(Cussler, Diffusion, 2009), less than 0.1 mm in a second, and no scene resolves that.
"""

from typing import Any

import numpy as np
import taichi as ti

from taichi_sph.boundary.boundary import BloodFlow, Boundary
from taichi_sph.boundary.inflow import BufferZones
from taichi_sph.errors import InputError
from taichi_sph.fluid.model import AccelerationModel
from taichi_sph.geometry.mesh import Floats
from taichi_sph.particles.particles import Quantity
from taichi_sph.runtime import float_dtype

DYE = Quantity("dye")
"""Concentration of the dye over that of the medium as injected [-]."""

UNTOUCHED = -1.0
"""Concentration of an inflow that nobody has said anything about: blood keeps what it has."""


class Tracer(Boundary):
    """Dye in the blood."""

    name = "tracer"

    def __init__(self, blood: BloodFlow, inflow: BufferZones):
        """Blood without dye; `inflow` is asked where blood comes in."""
        self.blood = blood
        particles = blood.particles
        self.dye: ti.Field = dict(zip(particles.names, particles.fields, strict=True))[DYE.name]
        """Concentration [-], shape (capacity,), in the order of the particles."""
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
        self.before_lists()

    def before_lists(self) -> None:
        """Mark the blood in the buffers, what was just added with it."""
        if self.in_use:
            mark_buffers(self.blood.particles, self._inflow.regions, self._inlet)

    def compile_kernels(self, model: AccelerationModel) -> None:
        """Mark nothing."""
        mark_ball(self.blood.particles, 0.0, 0.0, 0.0, 0.0, 0.0)
        mark_buffers(
            self.blood.particles, self._inflow.regions, np.full_like(self._inlet, UNTOUCHED)
        )

    def reset(self) -> None:
        """No dye comes in; the blood that has been put back has none."""
        self._inlet[:] = UNTOUCHED

    def save_state(self) -> dict[str, Any]:
        """Concentrations of what comes in; the particles' own are saved with them."""
        return {"inlet": self._inlet.tolist()}

    def load_state(self, saved: dict[str, Any]) -> None:
        """Go on from a saved state."""
        self._inlet[:] = saved["inlet"]


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
