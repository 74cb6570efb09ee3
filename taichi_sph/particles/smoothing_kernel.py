"""Smoothing kernel W of the SPH sums (Eq. 1)."""

import math
from dataclasses import dataclass

import numpy as np
import taichi as ti


@ti.data_oriented  # lets the class carry @ti.func
@dataclass(frozen=True)  # equal parameters share one compiled kernel
class WendlandC2:
    """Wendland C2 kernel in three dimensions.

    W(r) = 21/(2 pi R^3) (1 - q)^4 (1 + 4 q),  q = r/R < 1.
    Wendland (1995), doi:10.1007/BF02123482.

    Smooth at r = 0 and free of the pairing instability (Dehnen & Aly 2012,
    doi:10.1111/j.1365-2966.2012.21439.x); its gradient needs no division by r.
    """

    support_radius: float
    """R [m]: the paper's h, beyond which W is zero."""

    @property
    def smoothing_length(self) -> float:
        """Smoothing length of the SPH literature, R/2 [m]."""
        return 0.5 * self.support_radius

    @property
    def peak(self) -> float:
        """W(0) [1/m^3]; evaluated in double precision by Python."""
        return 21.0 / (2.0 * math.pi * self.support_radius**3)

    @property
    def slope_peak(self) -> float:
        """(dW/dr)/r at r = 0 [1/m^5]."""
        return -20.0 * self.peak / self.support_radius**2

    @ti.func
    def w(self, r):
        """W(r) [1/m^3], zero from r = R on."""
        s = ti.max(0.0, 1.0 - r * ti.static(1.0 / self.support_radius))
        return self.peak * s * s * s * s * (5.0 - 4.0 * s)

    @ti.func
    def slope(self, r):
        """Slope of W over distance, dW/dr / r [1/m^5]; times r_ij it is the gradient of W_ij."""
        s = ti.max(0.0, 1.0 - r * ti.static(1.0 / self.support_radius))
        return self.slope_peak * s * s * s

    def w_of(self, r: np.ndarray) -> np.ndarray:
        """W(r) for numpy, double precision."""
        s = np.maximum(0.0, 1.0 - np.asarray(r) / self.support_radius)
        return self.peak * s**4 * (5.0 - 4.0 * s)

    def slope_of(self, r: np.ndarray) -> np.ndarray:
        """(dW/dr)/r for numpy, double precision."""
        s = np.maximum(0.0, 1.0 - np.asarray(r) / self.support_radius)
        return self.slope_peak * s**3
