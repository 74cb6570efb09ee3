"""Viscosity of blood as a function of shear rate: one method, two laws, no `if` in a kernel."""

import math
from dataclasses import dataclass

import taichi as ti

from taichi_sph.scene import CassonTable, NewtonianTable


@ti.data_oriented
@dataclass(frozen=True)
class Newtonian:
    """Constant viscosity."""

    eta: float
    """Dynamic viscosity [Pa s]."""

    shear_dependent = False

    @property
    def largest_viscosity(self) -> float:
        """Upper bound of the viscosity [Pa s]."""
        return self.eta

    @ti.func
    def viscosity(self, shear_rate):
        """Mu [Pa s] at a shear rate [1/s]."""
        return self.eta


@ti.data_oriented
@dataclass(frozen=True)
class Casson:
    """Casson's law with Papanastasiou's regulariser (Eq. 8, corrected).

    mu(g) = (sqrt(eta) + sqrt(tau_y/g) (1 - exp(-sqrt(n g))))^2

    The paper prints exp(-n g), with which blood at rest is as thin as at high shear; the square
    root gives the finite plateau (sqrt(eta) + sqrt(n tau_y))^2 (Papanastasiou 1987,
    doi:10.1122/1.549926, applied to Casson's law).  `as_printed` selects the paper's form.
    """

    eta: float
    """Casson viscosity [Pa s]."""
    tau_y: float
    """Yield stress [Pa]."""
    n: float
    """Time of the regulariser [s]."""
    as_printed: bool = False
    """The exponent as the paper prints it."""

    shear_dependent = True

    @property
    def largest_viscosity(self) -> float:
        """Plateau at rest [Pa s]; bounds the printed form as well."""
        return (math.sqrt(self.eta) + math.sqrt(self.n * self.tau_y)) ** 2

    @ti.func
    def viscosity(self, shear_rate):
        """Mu [Pa s] at a shear rate [1/s]."""
        # Below 1e-12 1/s the quotient's limit is reached to 1e-5; 0/0 must not appear.
        g = ti.max(shear_rate, 1e-12)
        exponent = self.n * g
        if ti.static(not self.as_printed):
            exponent = ti.sqrt(exponent)
        # 1 - exp(-x) = 2 exp(-x/2) sinh(x/2) loses digits for small x: three terms of its series.
        rise = 1.0 - ti.exp(-exponent)
        if exponent < 1e-2:
            rise = exponent * (1.0 - exponent * (0.5 - exponent / 6.0))
        root = ti.static(math.sqrt(self.eta)) + ti.sqrt(self.tau_y / g) * rise
        return root * root


Rheology = Newtonian | Casson


@ti.func
def shear_rate(gradient):
    """Shear rate sqrt(2 D:D) [1/s], D the symmetric, traceless part of a velocity gradient."""
    g = gradient + gradient.transpose()
    third = g.trace() / 3.0
    square = 0.0
    for a, b in ti.static(ti.ndrange(3, 3)):
        entry = g[a, b] - (third if ti.static(a == b) else 0.0)
        square += entry * entry
    return ti.sqrt(0.5 * square)


def make_rheology(table: NewtonianTable | CassonTable) -> Rheology:
    """The viscosity law that a scene asks for."""
    if isinstance(table, NewtonianTable):
        return Newtonian(table.viscosity)
    return Casson(table.viscosity, table.yield_stress, table.regularisation, table.printed)
