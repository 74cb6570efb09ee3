"""Suction: takes blood near the tool's tip away, at a rate."""

from typing import Any

import taichi as ti

from taichi_sph.boundary.boundary import BloodFlow, Boundary, finite_numbers
from taichi_sph.boundary.outlets import SUCTION, Outlets
from taichi_sph.boundary.tool import Tool
from taichi_sph.fluid.model import AccelerationModel


class Suction(Boundary):
    """Takes at most so much blood a second from within a radius of the tool's tip."""

    name = "suction"

    def __init__(self, blood: BloodFlow, outlets: Outlets, tool: Tool, spacing: float):
        """Off at first; `outlets` counts what is taken, `spacing` [m] is that of the blood."""
        self.blood = blood
        self.outlets = outlets
        self.tool = tool
        self.spacing = spacing
        self.rate = 0.0
        """[m^3/s]"""
        self.radius = 2.0 * spacing
        """[m]"""
        self._backlog = 0.0
        """Particles that are due and not yet taken."""
        self._taken_until = 0.0
        """Time up to which the backlog is worked out [s]."""

    def set(self, rate: float, radius: float | None = None) -> None:
        """Take at most `rate` [m^3/s] of the blood within a radius [m]; two spacings without.

        Raises:
            InputError: a number is not finite.
        """
        finite_numbers("suction: rate [m^3/s]", rate)
        finite_numbers("suction: radius [m]", radius or 0.0)
        self.rate = rate
        self.radius = radius or 2.0 * self.spacing

    def before_lists(self) -> None:
        """Mark the blood that is due by now."""
        time = self.blood.time
        if self.rate > 0.0:
            self._backlog += self.rate * (time - self._taken_until) / self.spacing**3
            taken = 0
            if self._backlog >= 1.0:
                taken = self._aspirate(self.radius, int(self._backlog))
            # What is not there to be taken is not due.
            self._backlog = min(self._backlog - taken, 1.0)
        self._taken_until = time

    def _aspirate(self, radius: float, most: int) -> int:
        x, y, z = map(float, self.tool.position)
        return int(aspirate(self.blood.particles, self.outlets, x, y, z, radius, most))

    def before_drift(self, dt: float, model: AccelerationModel) -> float:
        """Tell how far the tip has moved: blood is taken when the lists are built.

        The tip of a tool with a surface goes no farther than its proxies, which the tool tells of.
        """
        mere_tip = self.tool.surface is None
        return self.tool.last_displacement if mere_tip and self.rate > 0.0 else 0.0

    def compile_kernels(self, model: AccelerationModel) -> None:
        """Take nothing."""
        self._aspirate(0.0, 0)

    def reset(self) -> None:
        """Off, and nothing is due."""
        self.rate, self._backlog, self._taken_until = 0.0, 0.0, self.blood.time

    def save_state(self) -> dict[str, Any]:
        """Rate, radius and what is due."""
        return {
            "rate": self.rate, "radius": self.radius, "backlog": self._backlog,
            "taken_until": self._taken_until,
        }  # fmt: skip

    def load_state(self, saved: dict[str, Any]) -> None:
        """Go on from a saved state."""
        self.rate, self.radius = saved["rate"], saved["radius"]
        self._backlog, self._taken_until = saved["backlog"], saved["taken_until"]


@ti.kernel
def aspirate(p: ti.template(), outlets: ti.template(), x: float, y: float, z: float, reach: float,
             most: int) -> int:  # fmt: skip
    """Mark at most so many particles near a point, in the order of the rows; returns how many.

    One after the other, so that which ones go does not depend on threads.
    Writes: identity, removed.
    """
    taken = 0
    ti.loop_config(serialize=True)
    for i in range(p.count[None]):
        near = (p.position[i] - ti.Vector([x, y, z])).norm() < reach
        if taken < most and p.identity[i] >= 0 and near:
            p.identity[i] = -2 - SUCTION
            taken += 1
    outlets.removed[SUCTION] += taken
    return taken
