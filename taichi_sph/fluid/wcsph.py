"""Weakly compressible SPH, the paper's physics (section 1), in two passes over the lists.

    a_i = a_i^pressure + a_i^viscous + sum_k a_ik^wall + g      [m/s^2]     (Eq. 5, per mass)

The first pass sums density with what changes it, the second the accelerations.  Everything is per
unit mass; the paper mixes forces, force densities and accelerations.

Sound is damped by a pressure that answers to the rate at which density rises, a bulk viscosity

    q_i = max(0, p_i/rho_i^2 + zeta c h_s (d(rho/rho_0)/dt)_i/rho_i)

(as the acoustic damper of Sun et al. 2023, doi:10.1016/j.jcp.2023.112056): shear, which changes no
density, does not feel it, as it would Monaghan's artificial viscosity.
"""

import math

import taichi as ti

from taichi_sph.fluid.density import density_sums
from taichi_sph.fluid.forces import (
    artificial_factor,
    mean_viscosity,
    pair_artificial_viscosity,
    pair_nested_stress,
    pair_pressure,
    pair_viscosity,
    wall_pair_acceleration,
)
from taichi_sph.fluid.local_datum import local_datum
from taichi_sph.fluid.model import Fluid
from taichi_sph.fluid.rheology import shear_rate
from taichi_sph.fluid.shifting import shifting_velocity
from taichi_sph.particles.neighbors import Neighbors
from taichi_sph.particles.particles import Particles
from taichi_sph.particles.wall import Wall, wall_velocity


class SphAcceleration:
    """Weakly compressible SPH with Casson blood and wall coupling."""

    name = "physics"
    used_fallback = False
    largest_viscosity = math.inf

    def __init__(self, fluid: Fluid, capacity: int):
        """Make the scratch fields for `capacity` particles."""
        self.fluid = fluid
        self.sound_speed = fluid.sound_speed
        self.pressure_term = ti.field(float, capacity)
        """p / rho^2 [m^5/(kg s^2)]."""
        self.viscosity = ti.field(float, capacity)
        """mu [Pa s]."""
        self.stress = ti.Matrix.field(3, 3, float, capacity if fluid.nested else 1)
        """tau [Pa], in the nested form only."""

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
        """Density, pressure and viscosity of each particle, then its acceleration."""
        sums = particles, wall, neighbors, self.fluid
        sum_density(*sums, self.pressure_term, self.viscosity, self.sound_speed)
        if self.fluid.nested:
            sum_stress(*sums, self.viscosity, self.stress)
        sum_acceleration(
            *sums, self.pressure_term, self.viscosity, self.stress, self.sound_speed, *gravity
        )

    def stable_step(self, largest_speed: float, largest_acceleration: float) -> float:
        """Smallest of the sound, viscous and force limits [s]."""
        return self.fluid.step_limits(
            self.sound_speed, largest_speed, largest_acceleration
        ).smallest


@ti.kernel
def sum_density(
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    pressure_term: ti.template(),
    viscosity: ti.template(),
    sound_speed: float,
):
    """Density (Eq. 2), q_i (Eq. 14), the viscosity of the shear rate (Eq. 8) and the shifting.

    | symbol | code | meaning | unit |
    |---|---|---|---|
    | rho_i | rho | density, the particle itself included | kg/m^3 |
    | L_i | gradient | velocity gradient, see `taichi_sph.fluid.density` | 1/s |
    | q_i | pressure_term | of the equation of state and the damping of sound | m^5/(kg s^2) |
    | mu_i | viscosity | of the shear rate sqrt(2 D:D) | Pa s |
    | c/(C h_s) | frequency | fewest steps that sound asks for | 1/s |

    The nested form has its own viscosity, see `sum_stress`.
    Reads: position, velocity.  Writes: density, shifting, pressure_term, viscosity.
    """
    h_s = ti.static(fluid.kernel.smoothing_length)
    frequency = sound_speed * ti.static(1.0 / (fluid.courant_number * h_s))
    for i in range(p.count[None]):
        rho, density_rises, _, gradient, concentration = density_sums(i, p, w, nb, fluid, 1.0)
        rate = shear_rate(gradient)
        p.density[i] = rho
        damping = ti.static(fluid.sound_damping * h_s) * sound_speed * density_rises
        pressure = fluid.equation_of_state.pressure(rho, sound_speed) / rho + damping
        pressure_term[i] = ti.max(0.0, pressure) / rho
        viscosity[i] = fluid.rheology.viscosity(rate)
        ratio = rho * ti.static(1.0 / fluid.rest_density)
        p.shifting[i] = shifting_velocity(fluid, ratio, rate, concentration, frequency)


@ti.kernel
def sum_stress(
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    viscosity: ti.template(),
    stress: ti.template(),
):
    """Viscous stress tau_i = 2 mu D of the nested form (Eqs. 6-8, 10; the factor 1/2 restored).

    Its velocity gradient has the neighbours' volumes m/rho_j, as printed: hence a pass of its own,
    once all densities are known.
    Reads: position, velocity, density.  Writes: viscosity, stress.
    """
    for i in range(p.count[None]):
        x_i = p.position[i]
        v_i = p.velocity[i]
        gradient = ti.Matrix.zero(float, 3, 3)
        for n in range(nb.blood_count[i]):
            j = nb.blood_index[i, n]
            r_ij = nb.grid.separation(x_i, p.position[j])
            slope = fluid.kernel.slope(r_ij.norm()) * ti.static(fluid.calibration.mass)
            gradient += (slope / p.density[j] * (p.velocity[j] - v_i)).outer_product(r_ij)
        for n in range(nb.wall_count[i]):
            k = nb.wall_index[i, n]
            r_ik = nb.grid.separation(x_i, w.position[k])
            slope = fluid.kernel.slope(r_ik.norm()) * ti.static(fluid.calibration.wall_gradient)
            v_ik = v_i - wall_velocity(w, k)
            gradient -= (w.volume[k] * slope * v_ik).outer_product(r_ik)
        gradient *= ti.static(fluid.calibration.gradient)
        viscosity[i] = fluid.rheology.viscosity(shear_rate(gradient))
        g = gradient + gradient.transpose()
        third = g.trace() / 3.0
        for a in ti.static(range(3)):
            g[a, a] -= third
        stress[i] = viscosity[i] * g


@ti.kernel
def sum_acceleration(
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    pressure_term: ti.template(),
    viscosity: ti.template(),
    stress: ti.template(),
    sound_speed: float,
    g_x: float,
    g_y: float,
    g_z: float,
):
    """Acceleration of each particle (Eq. 5): `taichi_sph.fluid.forces` has each term.

    Blood:
        a_ij = -m (p_i/rho_i^2 + p_j/rho_j^2 - 2 D_i + Pi_ij) grad W_ij
               + m 2 mu_ij/(rho_i rho_j) (r_ij.grad W_ij)/(r_ij^2 + eps) v_ij
    Wall:
        a_ik = -gamma rho_0 V_k (p_i/rho_i^2 - D_i + Pi_ik) grad W_ik
               + gamma_mu rho_0 F_k V_k 2 mu_i/rho_i^2 (r_ik.grad W_ik)/(r_ik^2 + eps) v_ik

    | symbol | code | meaning | unit |
    |---|---|---|---|
    | m, rho_0 | mass, fluid.rest_density | mass in the sums, rest density | kg, kg/m^3 |
    | p_i/rho_i^2 | p_i, pressure_term | pressure term | m^5/(kg s^2) |
    | D_i | datum | of particles that have it, see `local_datum` | m^5/(kg s^2) |
    | Pi_ij | | artificial viscosity, part of `pressure` | m^5/(kg s^2) |
    | mu_i, mu_ij | mu_i, mu_ij | viscosity, of a pair with its calibration and a factor 2 | Pa s |
    | gamma, gamma_mu | calibration.wall_density, wall_friction | of Eq. 3 | 1 |
    | F_k | w.friction | where the wall is curved | 1 |
    | a_i | a_i, a_wall | by blood, by the wall | m/s^2 |

    Reads: position, velocity, density, local_datum, scratch.
    Writes: acceleration, mean_pressure_term.
    """
    mass = ti.static(fluid.calibration.mass)
    for i in range(p.count[None]):
        x_i = p.position[i]
        v_i = p.velocity[i]
        rho_i = p.density[i]
        p_i = pressure_term[i]
        mu_i = viscosity[i]
        datum = local_datum(fluid, p, i)
        weight = fluid.kernel.w(0.0)
        mean = weight * p_i
        a_i = ti.Vector([0.0, 0.0, 0.0])
        for n in range(nb.blood_count[i]):
            j = nb.blood_index[i, n]
            r_ij = nb.grid.separation(x_i, p.position[j])
            r2 = r_ij.norm_sqr()
            softened = r2 + ti.static(fluid.softening)
            slope = fluid.kernel.slope(ti.sqrt(r2))
            v_ij = v_i - p.velocity[j]
            rho_j = p.density[j]
            p_j = pressure_term[j]
            pressure = pair_pressure(fluid, p_i - 2.0 * datum, p_j)
            if ti.static(p.has_local_datum):
                w_ij = fluid.kernel.w(ti.sqrt(r2))
                weight += w_ij
                mean += w_ij * p_j
            if ti.static(fluid.has_artificial_viscosity):
                alpha = artificial_factor(fluid, sound_speed, 0.5 * (rho_i + rho_j))
                pressure += pair_artificial_viscosity(alpha, r_ij, v_ij, softened, rho_i + rho_j)
            a_i -= (pressure * slope) * r_ij
            if ti.static(fluid.nested):
                a_i += pair_nested_stress(fluid, stress[i] + stress[j], r_ij, slope, rho_i, rho_j)
            else:
                mu_ij = mean_viscosity(fluid, mu_i, viscosity[j])
                mu_ij *= ti.static(2.0 * fluid.calibration.viscosity)
                a_i += pair_viscosity(mu_ij, slope, r2, softened, rho_i, rho_j) * v_ij
        if ti.static(p.has_local_datum):
            p.mean_pressure_term[i] = mean / weight
        a_i *= mass
        a_wall = ti.Vector([0.0, 0.0, 0.0])
        for n in range(nb.wall_count[i]):
            k = nb.wall_index[i, n]
            r_ik = nb.grid.separation(x_i, w.position[k])
            a_wall += wall_pair_acceleration(
                w, k, r_ik, v_i, rho_i, p_i - datum, mu_i, fluid, sound_speed
            )
        a_wall *= ti.static(fluid.rest_density)
        # A vector as an argument would cost 0.05 ms a launch.
        p.acceleration[i] = a_i + a_wall + ti.Vector([g_x, g_y, g_z])


@ti.kernel
def force_on_tool(
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    pressure_term: ti.template(),
    viscosity: ti.template(),
    sound_speed: float,
    datum: float,
    datum_x: float,
    datum_y: float,
    datum_z: float,
) -> ti.math.vec3:
    """Force F = -m sum_i sum_k a_ik over the proxies of the tool [N], as in `sum_acceleration`.

    m is the blood that a particle stands for.  To the pressure is added what a datum takes from it:
    its value at the origin [Pa] and its gradient [Pa/m].
    Reads: position, velocity, density, scratch.
    """
    force = ti.Vector([0.0, 0.0, 0.0])
    slope = ti.Vector([datum_x, datum_y, datum_z])
    for i in range(p.count[None]):
        for n in range(nb.wall_count[i]):
            k = nb.wall_index[i, n]
            if k >= w.count:
                r_ik = nb.grid.separation(p.position[i], w.position[k])
                rho = p.density[i]
                whole = pressure_term[i] + (datum + slope.dot(p.position[i])) / (rho * rho)
                force -= wall_pair_acceleration(
                    w, k, r_ik, p.velocity[i], rho, whole, viscosity[i], fluid, sound_speed
                )
    return ti.static(p.mass * fluid.rest_density) * force
