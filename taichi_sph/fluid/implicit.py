"""Implicit pressure: steps as long as blood's own motion allows, by a few Jacobi iterations.

A step of T wants the pressures that leave no compression at its end (implicit incompressible SPH:
Ihmsen et al. 2014, doi:10.1109/TVCG.2013.105).  With q_i = p_i/rho_i^2,

    q_i^0     = max(0, k (rho_i/rho_0 - 1) - g T div v_i) / (T^2 rho_0 D_i)
    q_i^{l+1} = max(0, q_i^l + omega (rho_i/rho_0 - 1 - T div(v + T a(q^l))_i) / (T^2 rho_0 D_i))

| symbol | code | meaning | unit |
|---|---|---|---|
| T | interval | step | s |
| q_i | pressure_term | pressure term | m^5/(kg s^2) |
| -div v_i | rate | d(rho/rho_0)/dt | 1/s |
| D_i | | answer of the density to the particle's own pressure, see `density` | 1/m^2 |
| T^2 rho_0 D_i | diagonal | of the system of equations | kg s^2/m^5 |
| k, g, omega | STIFFNESS, DAMPING, RELAXATION | of the initial pressure, of an iteration | 1 |

The compression that is left is what one step tells the next: no pressure is carried over.
Viscosity is explicit, as in the physics.

For a mode whose compression falls by s q under a pressure q, an iteration makes K = k (1 - omega s)
+ omega of k, and G of g alike.  The step is stable where K > 0, s G < 2 and s (K + 2 G) < 4.
Clouds reach s = 3.82 (see the tests): omega = 0.34 holds that for any number of iterations and any
k in [0, 1], g in [0, 0.3].
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import taichi as ti

from taichi_sph.fluid.density import density_rate, density_sums
from taichi_sph.fluid.model import Fluid
from taichi_sph.fluid.rheology import shear_rate
from taichi_sph.fluid.shifting import shifting_velocity
from taichi_sph.fluid.wcsph import sum_acceleration
from taichi_sph.particles.neighbors import Neighbors
from taichi_sph.particles.particles import Particles
from taichi_sph.particles.wall import Wall, wall_velocity
from taichi_sph.scene import Scene

STIFFNESS = 1.0
"""Factor k of the initial pressure: all of the compression is to go in one step."""
DAMPING = 0.3
"""Factor g of the initial pressure."""
RELAXATION = 0.34
"""Relaxation factor omega of the Jacobi iterations."""
ITERATIONS = 1
"""Iterations a step, where nothing else is asked for."""
ADVECTIVE_CFL = 0.145
"""Way of blood at the scene's largest speed in a step, v T/R.  Twice as far, and thin blood that
hits a wall is compressed by a quarter, whatever the iterations: they know the wall only as it was.
"""
LARGEST_ADVECTIVE_CFL = 0.4
"""Largest way v T/R of any particle in a step."""
SMALLEST_DIAGONAL = 0.5
"""Lower bound of R^2 D, which is 1.8 on a lattice: a lone pair that hardly touches must not be
thrown apart."""
LARGEST_VISCOSITY = 0.03
"""Upper bound of mu T/(rho_0 R^2): what an explicit step bears (Morris et al. 1997)."""


def advective_step(interval: float, support_radius: float, largest_speed: float) -> float:
    """Step T [s], or less where blood is so fast that v T/R would exceed LARGEST_ADVECTIVE_CFL."""
    largest = LARGEST_ADVECTIVE_CFL * support_radius / interval
    return interval * min(1.0, largest / max(largest_speed, largest))


class InitialPressure(Protocol):
    """First estimate of the pressure in a step, with all that the iterations need."""

    def __call__(
        self, particles: Particles, wall: Wall, neighbors: Neighbors, model: "ImplicitAcceleration"
    ) -> None:
        """Write density and the model's pressure_term, viscosity and diagonal."""
        ...


def pressure_from_density(
    particles: Particles, wall: Wall, neighbors: Neighbors, model: "ImplicitAcceleration"
) -> None:
    """Estimate the pressure from density and its rate, as the module's first equation."""
    estimate_pressure(
        particles, wall, neighbors, model.fluid, model.interval, model.pressure_term,
        model.viscosity, model.diagonal,
    )  # fmt: skip


class ImplicitAcceleration:
    """The sums of the physics under a pressure that leaves little compression after a step."""

    used_fallback = False

    def __init__(
        self,
        fluid: Fluid,
        capacity: int,
        interval: float,
        iterations: int = ITERATIONS,
        initial_pressure: InitialPressure = pressure_from_density,
        name: str = "implicit",
    ):
        """Make the scratch fields for `capacity` particles.

        Args:
            fluid: constants of the sums; the viscous stress is pairwise here.
            capacity: rows of the particles.
            interval: step T at the start [s]; it goes with 1/c.
            iterations: Jacobi iterations after the initial pressure.
            initial_pressure: what estimates the pressure first.
            name: for summaries.
        """
        self.name = name
        self.fluid = replace(fluid, nested=False)
        self.sound_speed = fluid.sound_speed
        self._interval_at_start = interval
        self.iterations = iterations
        self.initial_pressure = initial_pressure
        self.pressure_term = ti.field(float, capacity)
        """p / rho^2 [m^5/(kg s^2)]."""
        self.viscosity = ti.field(float, capacity)
        """mu [Pa s]."""
        self.diagonal = ti.field(float, capacity)
        """T^2 rho_0 D [kg s^2/m^5]."""
        self.stress = ti.Matrix.field(3, 3, float, 1)
        """Stress of the nested form, which is not in use; kernels want a field."""

    @property
    def interval(self) -> float:
        """Present step T [s]."""
        return self._interval_at_start * (self.fluid.sound_speed / self.sound_speed)

    @property
    def largest_viscosity(self) -> float:
        """Bound of mu, LARGEST_VISCOSITY rho_0 R^2/T [Pa s]."""
        radius = self.fluid.kernel.support_radius
        return LARGEST_VISCOSITY * self.fluid.rest_density * radius**2 / self.interval

    @property
    def pair_coefficients(self) -> tuple[Fluid, ti.Field, ti.Field, float]:
        """Constants, p/rho^2, mu and c."""
        return self.fluid, self.pressure_term, self.viscosity, self.sound_speed

    def accelerate(
        self,
        particles: Particles,
        wall: Wall,
        neighbors: Neighbors,
        gravity: tuple[float, float, float],
    ) -> None:
        """Initial pressure and its forces, then iterations of the pressure and its forces."""
        sums = particles, wall, neighbors, self.fluid
        self.initial_pressure(particles, wall, neighbors, self)
        for remaining in range(self.iterations, -1, -1):
            sum_acceleration(
                *sums, self.pressure_term, self.viscosity, self.stress, self.sound_speed, *gravity
            )
            if remaining:
                correct_pressure(*sums, self.interval, self.diagonal, self.pressure_term)

    def stable_step(self, largest_speed: float, largest_acceleration: float) -> float:
        """Step T, or less, as `advective_step` [s]."""
        return advective_step(self.interval, self.fluid.kernel.support_radius, largest_speed)


def implicit_factory(
    scene: Scene, advective_cfl: float = ADVECTIVE_CFL, iterations: int = ITERATIONS
) -> Callable[[Fluid, int], ImplicitAcceleration]:
    """Factory of implicit models for `Simulation`, whose step suits a scene's largest speed."""

    def make(fluid: Fluid, capacity: int) -> ImplicitAcceleration:
        speed = fluid.sound_speed / scene.discretization.sound_speed_ratio
        interval = advective_cfl * fluid.kernel.support_radius / speed
        return ImplicitAcceleration(fluid, capacity, interval, iterations)

    return make


@ti.kernel
def estimate_pressure(
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    interval: float,
    pressure_term: ti.template(),
    viscosity: ti.template(),
    diagonal: ti.template(),
):
    """Density, q^0, viscosity and T^2 rho_0 D of each particle (module's first equation).

    Reads: position, velocity.  Writes: density, shifting, pressure_term, viscosity, diagonal.
    """
    rest_density = ti.static(fluid.rest_density)
    radius = ti.static(fluid.kernel.support_radius)
    thickest = ti.static(LARGEST_VISCOSITY) * rest_density * radius * radius / interval
    least = ti.static(SMALLEST_DIAGONAL / fluid.kernel.support_radius**2)
    for i in range(p.count[None]):
        ratio, rate, response, gradient, concentration = density_sums(
            i, p, w, nb, fluid, fluid.rest_density
        )
        sheared = shear_rate(gradient)
        p.shifting[i] = shifting_velocity(fluid, ratio, sheared, concentration, 1.0 / interval)
        diagonal[i] = interval * interval * rest_density * ti.max(least, response)
        p.density[i] = ratio * rest_density
        excess = ti.static(STIFFNESS) * (ratio - 1.0) + ti.static(DAMPING) * interval * rate
        pressure_term[i] = ti.max(0.0, excess) / diagonal[i]
        viscosity[i] = ti.min(thickest, fluid.rheology.viscosity(sheared))


@ti.kernel
def correct_pressure(
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    interval: float,
    diagonal: ti.template(),
    pressure_term: ti.template(),
):
    """One Jacobi iteration (module's second equation).

    Reads: position, velocity, acceleration, density.  Writes: pressure_term.
    """
    rest_density = ti.static(fluid.rest_density)
    for i in range(p.count[None]):
        x_i = p.position[i]
        v_i = p.velocity[i] + interval * p.acceleration[i]
        blood = 0.0
        for n in range(nb.blood_count[i]):
            j = nb.blood_index[i, n]
            r_ij = nb.grid.separation(x_i, p.position[j])
            v_ij = v_i - p.velocity[j] - interval * p.acceleration[j]
            blood += fluid.kernel.slope(r_ij.norm()) * v_ij.dot(r_ij)
        wall = 0.0
        for n in range(nb.wall_count[i]):
            k = nb.wall_index[i, n]
            r_ik = nb.grid.separation(x_i, w.position[k])
            v_ik = v_i - wall_velocity(w, k)
            wall += w.volume[k] * fluid.kernel.slope(r_ik.norm()) * v_ik.dot(r_ik)
        after = p.density[i] / rest_density - 1.0 + interval * density_rate(fluid, blood, wall)
        pressure_term[i] = ti.max(
            0.0, pressure_term[i] + ti.static(RELAXATION) * after / diagonal[i]
        )
