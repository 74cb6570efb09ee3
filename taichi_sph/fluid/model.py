"""What stands behind every acceleration: the protocol of a model, the liquid, the step's limits."""

import math
from dataclasses import dataclass
from typing import Protocol

import taichi as ti

from taichi_sph.fluid.calibration import Calibration, softening
from taichi_sph.fluid.equation_of_state import Tait
from taichi_sph.fluid.rheology import Rheology
from taichi_sph.particles.neighbors import Neighbors
from taichi_sph.particles.particles import Particles
from taichi_sph.particles.smoothing_kernel import WendlandC2
from taichi_sph.particles.wall import Wall


class AccelerationModel(Protocol):
    """How an acceleration is computed: by physics, or by a network trained on it."""

    name: str
    """Short name for summaries."""
    sound_speed: float
    """Present sound speed c [m/s]; a simulation sets it before a step."""

    @property
    def largest_viscosity(self) -> float:
        """Bound that mu is held at for the step [Pa s]; infinite where the step gives way."""
        ...

    @property
    def used_fallback(self) -> bool:
        """Whether the last acceleration is the physics', since the model did not trust itself."""
        ...

    @property
    def pair_coefficients(self) -> "tuple[Fluid, ti.Field, ti.Field, float] | None":
        """What the last forces were summed from: constants, p/rho^2, mu and c; None if from none.

        p is measured from the datum, see `taichi_sph.boundary.datum`.
        """
        ...

    def accelerate(
        self,
        particles: Particles,
        wall: Wall,
        neighbors: Neighbors,
        gravity: tuple[float, float, float],
    ) -> None:
        """Replace ``particles.acceleration`` [m/s^2]; change nothing else but own scratch.

        The old values may be read: they are the previous step's accelerations.
        ``particles.density`` and ``particles.shifting`` must be written too: diagnostics read the
        one, the integrator the other.
        """
        ...

    def stable_step(self, largest_speed: float, largest_acceleration: float) -> float:
        """Longest admissible step [s] at a largest speed [m/s] and acceleration [m/s^2]."""
        ...


@ti.data_oriented
@dataclass(frozen=True)
class Fluid:
    """Everything that is constant in the sums."""

    kernel: WendlandC2
    equation_of_state: Tait
    rheology: Rheology
    calibration: Calibration
    spacing: float
    """d [m]."""
    artificial_viscosity: float = 0.0
    """Monaghan's alpha [-]."""
    nested: bool = False
    """Viscous stress in the paper's nested form (Eqs. 10 and 12)."""
    courant_number: float = 0.4
    """Step over h_s/(c + v) [-]."""
    sound_damping: float = 1.0
    """Factor zeta of the damping of sound, see `taichi_sph.fluid.wcsph` [-]."""
    thin_viscosity: float = 0.05
    """Monaghan's alpha where blood is thin, see `taichi_sph.fluid.forces` [-]."""
    shifting: float = 20.0
    """Factor s of the shifting, see `taichi_sph.fluid.shifting` [-]."""

    @property
    def rest_density(self) -> float:
        """rho_0 [kg/m^3]."""
        return self.equation_of_state.rest_density

    @property
    def sound_speed(self) -> float:
        """Sound speed c at rest density at the start [m/s]."""
        return self.equation_of_state.sound_speed

    @property
    def rest_volume(self) -> float:
        """Volume V = m/rho_0 that a particle has in the sums at rest density [m^3]."""
        return self.calibration.mass / self.rest_density

    @property
    def softening(self) -> float:
        """Term eps that keeps v.r/(r^2 + eps) finite [m^2]."""
        return softening(self.kernel)

    @property
    def has_artificial_viscosity(self) -> bool:
        """Whether any blood has it."""
        return self.artificial_viscosity > 0.0 or self.thin_viscosity > 0.0

    def step_limits(self, sound_speed: float, speed: float, acceleration: float) -> "StepLimits":
        """Limits of an explicit step at c, a largest speed [m/s] and acceleration [m/s^2]."""
        return stable_step_limits(
            self.kernel.smoothing_length, self.rest_density, self.rheology.largest_viscosity,
            sound_speed, self.courant_number, speed, acceleration,
        )  # fmt: skip


@dataclass(frozen=True)
class StepLimits:
    """Limits of an explicit step, each [s]."""

    sound: float
    """C h_s/(c + v): sound and blood must not outrun the smoothing length (Monaghan 1992)."""
    viscosity: float
    """0.125 h_s^2 rho_0/mu: momentum must not diffuse farther (Morris et al. 1997)."""
    force: float
    """0.25 sqrt(h_s/a): nor may a force push farther; infinite where nothing accelerates."""

    @property
    def smallest(self) -> float:
        """Longest step that all limits allow [s]."""
        return min(self.sound, self.viscosity, self.force)


def stable_step_limits(
    smoothing_length: float,
    rest_density: float,
    largest_viscosity: float,
    sound_speed: float,
    courant_number: float,
    speed: float,
    acceleration: float = 0.0,
) -> StepLimits:
    """Limits of an explicit step of weakly compressible SPH.

    Monaghan 1992 (C = 0.4) and Morris et al. 1997, doi:10.1006/jcph.1997.5776, section 3.5.

    Args:
        smoothing_length: h_s [m].
        rest_density: rho_0 [kg/m^3].
        largest_viscosity: upper bound of mu [Pa s].
        sound_speed: c [m/s].
        courant_number: C [-].
        speed: largest speed of blood v [m/s].
        acceleration: largest acceleration of blood a [m/s^2].
    """
    h = smoothing_length
    return StepLimits(
        sound=courant_number * h / (sound_speed + speed),
        viscosity=0.125 * h * h * rest_density / largest_viscosity,
        force=0.25 * (h / acceleration) ** 0.5 if acceleration > 0.0 else math.inf,
    )
