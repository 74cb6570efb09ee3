"""Pressure from density: the law in Taichi, for the sums, and in numpy beside it."""

from dataclasses import dataclass

import numpy as np
import taichi as ti


@ti.data_oriented
@dataclass(frozen=True)
class Tait:
    """Tait's equation, Eq. 14: p = rho_0 c^2/gamma ((rho/rho_0)^gamma - 1), never below zero.

    Without the bound a free surface, whose density sum lacks neighbours, would pull particles
    together and onto walls.  A flow that fills its vessel has no free surface; a background
    pressure keeps such a flow away from the bound.
    """

    rest_density: float
    """rho_0 [kg/m^3]."""
    sound_speed: float
    """c at the start [m/s]."""
    background_pressure: float = 0.0
    """Pressure at rest density [Pa]."""

    exponent = 7
    """Exponent gamma: Cole (1948), as the paper; a whole number."""

    @property
    def stiffness(self) -> float:
        """Stiffness rho_0 c^2/gamma at the start [Pa]."""
        return self.rest_density * self.sound_speed**2 / self.exponent

    @ti.func
    def pressure(self, density, sound_speed):
        """Pressure p [Pa] at the present sound speed [m/s]."""
        ratio = density * ti.static(1.0 / self.rest_density)
        stiffness = ti.static(self.rest_density / self.exponent) * sound_speed * sound_speed
        return ti.max(
            0.0,
            stiffness * (ratio ** ti.static(self.exponent) - 1.0) + self.background_pressure,
        )

    def pressure_of(self, density: np.ndarray) -> np.ndarray:
        """Pressure p [Pa] at the start's sound speed, double precision, shape of `density`."""
        power = (np.asarray(density, dtype=float) / self.rest_density) ** self.exponent
        return np.maximum(0.0, self.stiffness * (power - 1.0) + self.background_pressure)
