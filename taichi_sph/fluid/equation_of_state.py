"""Pressure from density."""

from dataclasses import dataclass

import taichi as ti


@ti.data_oriented
@dataclass(frozen=True)
class Tait:
    """Tait's equation, Eq. 14: p = rho_0 c^2 / 7 ((rho/rho_0)^7 - 1), never below zero.

    Without the bound a free surface, whose density sum lacks neighbours, would pull particles
    together and onto walls.  A flow that fills its vessel has no free surface; a background
    pressure keeps such a flow away from the bound.
    """

    rest_density: float
    """rho_0 [kg/m^3]."""
    sound_speed: float
    """c [m/s]."""
    background_pressure: float = 0.0
    """Pressure at rest density [Pa]."""

    gamma = 7
    """Exponent; Cole (1948), as the paper."""

    @property
    def stiffness(self) -> float:
        """rho_0 c^2 / gamma [Pa]."""
        return self.rest_density * self.sound_speed**2 / self.gamma

    @ti.func
    def pressure(self, density):
        """Pressure p [Pa]."""
        c = density * ti.static(1.0 / self.rest_density)
        c2 = c * c
        c6 = c2 * c2 * c2
        return ti.max(0.0, self.stiffness * (c6 * c - 1.0) + self.background_pressure)
