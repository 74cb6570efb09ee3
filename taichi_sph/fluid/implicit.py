"""Implicit pressure: steps as long as blood's own motion allows, by a few Jacobi rounds.

A step of T wants the pressures that leave no compression at its end (implicit incompressible SPH:
Ihmsen et al. 2014, doi:10.1109/TVCG.2013.105).  With q_i = p_i/rho_i^2,

    q_i^0     = max(0, k (rho_i/rho_0 - 1) - g T div v_i) / (T^2 rho_0 D_i)
    q_i^{l+1} = max(0, q_i^l + omega (rho_i/rho_0 - 1 - T div(v + T a(q^l))_i) / (T^2 rho_0 D_i))

D_i is the density's answer to the particle's own pressure (Bender and Koschier 2017,
doi:10.1109/TVCG.2016.2578335, eq. 9).  The compression that is left is what one step tells the
next: no pressure is carried over.  Viscosity is explicit, as in the physics.

For a mode whose compression falls by s q under a pressure q, a round makes K = k (1 - omega s) +
omega of k, and G of g alike.  The step is stable where K > 0, s G < 2 and s (K + 2 G) < 4.
Clouds reach s = 3.82 (see the tests): omega = 0.34 holds that for any number of rounds and any
k in [0, 1], g in [0, 0.3].
"""

from collections.abc import Callable
from dataclasses import replace

import taichi as ti

from taichi_sph.fluid.wcsph import Fluid, SphAcceleration, shear_rate, sum_acceleration
from taichi_sph.particles.neighbors import Neighbors
from taichi_sph.particles.particles import Particles
from taichi_sph.particles.wall import Wall, wall_velocity
from taichi_sph.scene import Scene

STIFFNESS = 1.0
"""k of the first guess."""
DAMPING = 0.3
"""g of the first guess."""
RELAXATION = 0.34
"""omega."""
ROUNDS = 1
"""Rounds a step."""
ADVANCE = 0.145
"""Way of blood at the scene's largest speed in a step T, over R.  Twice as far, and thin blood that
hits a wall is compressed by a quarter, whatever the rounds: they know the wall only as it was."""
LARGEST_ADVANCE = 0.4
"""No particle goes farther than this in a step, over R."""
LEAST_RESPONSE = 0.5
"""R^2 D is 1.8 on a lattice; a lone pair that hardly touches must not be thrown apart."""
LARGEST_VISCOSITY = 0.03
"""Of rho_0 R^2/T: what an explicit step bears (Morris et al. 1997)."""


def step_within_reach(interval: float, support_radius: float, largest_speed: float) -> float:
    """T [s], or less where blood is so fast that it would go farther than LARGEST_ADVANCE R."""
    largest = LARGEST_ADVANCE * support_radius / interval
    return interval * min(1.0, largest / max(largest_speed, largest))


class ImplicitAcceleration:
    """The physics' sums under a pressure that looks a step ahead."""

    name = "implicit"
    used_fallback = False

    def __init__(self, fluid: Fluid, capacity: int, interval: float, rounds: int = ROUNDS):
        """Make the scratch fields; `interval` is T [s], `rounds` the Jacobi rounds a step."""
        self.fluid = replace(fluid, nested=False)
        self.interval = interval
        self.rounds = rounds
        self.physics = SphAcceleration(fluid, capacity)
        self.response = ti.field(float, capacity)
        """T^2 rho_0 D [kg s^2/m^5]."""

    @property
    def pair_coefficients(self) -> tuple[Fluid, ti.Field, ti.Field]:
        """Constants, p/rho^2 and mu."""
        return self.fluid, self.physics.pressure_term, self.physics.viscosity

    def guess(self, particles: Particles, wall: Wall, neighbors: Neighbors) -> None:
        """Density, first pressure, viscosity and response of each particle."""
        guess_pressure(
            particles, wall, neighbors, self.fluid, self.interval, self.physics.pressure_term,
            self.physics.viscosity, self.response,
        )  # fmt: skip

    def accelerate(
        self,
        particles: Particles,
        wall: Wall,
        neighbors: Neighbors,
        gravity: tuple[float, float, float],
    ) -> None:
        """The guess and its forces, then rounds of better pressures and their forces."""
        sums, own = (particles, wall, neighbors, self.fluid), self.physics
        self.guess(particles, wall, neighbors)
        for remaining in range(self.rounds, -1, -1):
            sum_acceleration(*sums, own.pressure_term, own.viscosity, own.stress, *gravity)
            if remaining:
                correct_pressure(*sums, self.interval, self.response, own.pressure_term)

    def stable_step(self, largest_speed: float, largest_acceleration: float) -> float:
        """T, or less, as `step_within_reach` [s]."""
        return step_within_reach(self.interval, self.fluid.kernel.support_radius, largest_speed)


def implicit_factory(
    scene: Scene, advance: float = ADVANCE, rounds: int = ROUNDS
) -> Callable[[Fluid, int], ImplicitAcceleration]:
    """A maker of implicit models for `Simulation`, whose step suits a scene's largest speed."""

    def make(fluid: Fluid, capacity: int) -> ImplicitAcceleration:
        speed = fluid.equation_of_state.sound_speed / scene.discretization.sound_speed_ratio
        interval = advance * fluid.kernel.support_radius / speed
        return ImplicitAcceleration(fluid, capacity, interval, rounds)

    return make


@ti.kernel
def guess_pressure(
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    interval: float,
    pressure_term: ti.template(),
    viscosity: ti.template(),
    response: ti.template(),
):
    """Density, q^0, viscosity and T^2 rho_0 D of each particle (module's first equation).

    Reads: position, velocity.  Writes: density, pressure_term, viscosity, response.
    """
    rest_density = ti.static(fluid.equation_of_state.rest_density)
    share = ti.static(fluid.calibration.mass / fluid.equation_of_state.rest_density)
    gamma = ti.static(fluid.calibration.wall_density)
    radius = ti.static(fluid.kernel.support_radius)
    thickest = ti.static(LARGEST_VISCOSITY) * rest_density * radius * radius / interval
    for i in range(p.count[None]):
        x_i = p.position[i]
        v_i = p.velocity[i]
        blood = fluid.kernel.w(0.0)
        gradient = ti.Matrix.zero(float, 3, 3)
        sum_g = ti.Vector([0.0, 0.0, 0.0])
        sum_g2 = 0.0
        rate = 0.0
        for n in range(nb.blood_count[i]):
            j = nb.blood_index[i, n]
            r_ij = nb.grid.separation(x_i, p.position[j])
            r2 = r_ij.norm_sqr()
            r = ti.sqrt(r2)
            slope = fluid.kernel.slope(r)
            v_ji = p.velocity[j] - v_i
            blood += fluid.kernel.w(r)
            rate -= slope * v_ji.dot(r_ij)
            sum_g += slope * r_ij
            sum_g2 += slope * slope * r2
            if ti.static(fluid.rheology.shear_dependent):
                gradient += (slope * v_ji).outer_product(r_ij)
        gradient *= ti.static(fluid.calibration.gradient) * share
        behind = 0.0
        wall_g = ti.Vector([0.0, 0.0, 0.0])
        wall_gradient = ti.Matrix.zero(float, 3, 3)
        for n in range(nb.wall_count[i]):
            k = nb.wall_index[i, n]
            r_ik = nb.grid.separation(x_i, w.position[k])
            r = r_ik.norm()
            slope = fluid.kernel.slope(r) * w.volume[k]
            behind += w.volume[k] * fluid.kernel.w(r)
            wall_g += slope * r_ik
            if ti.static(w.moves):
                wall_gradient += (slope * wall_velocity(w, k)).outer_product(r_ik)
        wall_gradient -= v_i.outer_product(wall_g)
        if ti.static(fluid.rheology.shear_dependent):
            factor = ti.static(fluid.calibration.gradient * fluid.calibration.wall_gradient)
            gradient += factor * wall_gradient
        ratio = share * blood + gamma * behind
        # d(rho/rho_0)/dt
        rate = share * rate - gamma * wall_gradient.trace()
        one_sided = share * sum_g + gamma * wall_g
        d = one_sided.norm_sqr() + share * share * sum_g2
        least = ti.static(LEAST_RESPONSE / fluid.kernel.support_radius**2)
        response[i] = interval * interval * rest_density * ti.max(least, d)
        p.density[i] = ratio * rest_density
        excess = ti.static(STIFFNESS) * (ratio - 1.0) + ti.static(DAMPING) * interval * rate
        pressure_term[i] = ti.max(0.0, excess) / response[i]
        viscosity[i] = ti.min(thickest, fluid.rheology.viscosity(shear_rate(gradient)))


@ti.kernel
def correct_pressure(
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    interval: float,
    response: ti.template(),
    pressure_term: ti.template(),
):
    """One Jacobi round (module's second equation).

    Reads: position, velocity, acceleration, density.  Writes: pressure_term.
    """
    rest_density = ti.static(fluid.equation_of_state.rest_density)
    share = ti.static(fluid.calibration.mass / fluid.equation_of_state.rest_density)
    gamma = ti.static(fluid.calibration.wall_density)
    for i in range(p.count[None]):
        x_i = p.position[i]
        v_i = p.velocity[i] + interval * p.acceleration[i]
        rate = 0.0
        for n in range(nb.blood_count[i]):
            j = nb.blood_index[i, n]
            r_ij = nb.grid.separation(x_i, p.position[j])
            v_ij = v_i - p.velocity[j] - interval * p.acceleration[j]
            rate += fluid.kernel.slope(r_ij.norm()) * v_ij.dot(r_ij)
        behind = 0.0
        for n in range(nb.wall_count[i]):
            k = nb.wall_index[i, n]
            r_ik = nb.grid.separation(x_i, w.position[k])
            v_ik = v_i - wall_velocity(w, k)
            behind += w.volume[k] * fluid.kernel.slope(r_ik.norm()) * v_ik.dot(r_ik)
        after = p.density[i] / rest_density - 1.0 + interval * (share * rate + gamma * behind)
        pressure_term[i] = ti.max(
            0.0, pressure_term[i] + ti.static(RELAXATION) * after / response[i]
        )
