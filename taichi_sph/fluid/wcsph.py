"""The seam: whatever can say how blood accelerates, and the paper's physics that does (section 1).

    a_i = a_i^pressure + a_i^viscous + sum_k a_ik^wall + g      [m/s^2]     (Eq. 5, per mass)

in two passes over the neighbour lists: density (with the shear rate, where blood is not
Newtonian), then the accelerations.  Everything below is per unit mass; the paper mixes forces,
force densities and accelerations.
"""

from dataclasses import dataclass
from typing import Protocol

import taichi as ti

from taichi_sph.fluid.calibration import Calibration, softening
from taichi_sph.fluid.equation_of_state import Tait
from taichi_sph.fluid.rheology import Rheology
from taichi_sph.particles.neighbors import Neighbors
from taichi_sph.particles.particles import Particles
from taichi_sph.particles.smoothing_kernel import WendlandC2
from taichi_sph.particles.wall import Wall, wall_velocity


class AccelerationModel(Protocol):
    """How an acceleration is computed: by physics, or by a network trained on it."""

    name: str
    """Short name for summaries."""

    @property
    def used_fallback(self) -> bool:
        """Whether the last acceleration is the physics', since the model did not trust itself."""
        ...

    @property
    def pair_coefficients(self) -> "tuple[Fluid, ti.Field, ti.Field] | None":
        """What the last forces were summed from: constants, p/rho^2 and mu; None if from none."""
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
        ``particles.density`` must be written too: diagnostics read it.
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
    artificial_viscosity: float
    """Monaghan's alpha [-]."""
    nested: bool = False
    """Viscous stress in the paper's nested form (Eqs. 10 and 12)."""
    courant_number: float = 0.4
    """Step over h_s/(c + v) [-]."""

    @property
    def softening(self) -> float:
        """Keeps v.r/r^2 finite [m^2]."""
        return softening(self.kernel)

    @property
    def signal(self) -> float:
        """Alpha h_s c [m^2/s] of the artificial viscosity."""
        return (
            self.artificial_viscosity
            * self.kernel.smoothing_length
            * self.equation_of_state.sound_speed
        )


class SphAcceleration:
    """Weakly compressible SPH with Casson blood and wall coupling."""

    name = "physics"
    used_fallback = False

    def __init__(self, fluid: Fluid, capacity: int):
        """Make the scratch fields for `capacity` particles."""
        self.fluid = fluid
        self.pressure_term = ti.field(float, capacity)
        """p / rho^2 [m^5/(kg s^2)]."""
        self.viscosity = ti.field(float, capacity)
        """mu [Pa s]."""
        self.stress = ti.Matrix.field(3, 3, float, capacity if fluid.nested else 1)
        """tau [Pa], in the nested form only."""

    @property
    def pair_coefficients(self) -> tuple[Fluid, ti.Field, ti.Field]:
        """Constants, p/rho^2 and mu."""
        return self.fluid, self.pressure_term, self.viscosity

    def accelerate(
        self,
        particles: Particles,
        wall: Wall,
        neighbors: Neighbors,
        gravity: tuple[float, float, float],
    ) -> None:
        """Density, pressure and viscosity of each particle, then its acceleration."""
        sum_density(particles, wall, neighbors, self.fluid, self.pressure_term, self.viscosity)
        if self.fluid.nested:
            sum_stress(particles, wall, neighbors, self.fluid, self.viscosity, self.stress)
        sum_acceleration(
            particles,
            wall,
            neighbors,
            self.fluid,
            self.pressure_term,
            self.viscosity,
            self.stress,
            *gravity,
        )

    def stable_step(self, largest_speed: float, largest_acceleration: float) -> float:
        """Smallest of the sound, viscous and force limits [s].

        C h_s/(c + v), 0.125 h_s^2 rho/mu, 0.25 sqrt(h_s/a): Monaghan 1992 (C = 0.4) and Morris
        et al. 1997, doi:10.1006/jcph.1997.5776, section 3.5.
        """
        h = self.fluid.kernel.smoothing_length
        state = self.fluid.equation_of_state
        step = self.fluid.courant_number * h / (state.sound_speed + largest_speed)
        step = min(step, 0.125 * h * h * state.rest_density / self.fluid.rheology.largest_viscosity)
        if largest_acceleration > 0.0:
            step = min(step, 0.25 * (h / largest_acceleration) ** 0.5)
        return step


@ti.kernel
def sum_density(
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    pressure_term: ti.template(),
    viscosity: ti.template(),
):
    """rho_i = m sum_j W_ij + gamma sum_k rho_0 V_k W_ik (Eq. 2), the particle itself included.

    Also p_i/rho_i^2 (Eq. 14) and, where blood is not Newtonian, mu(|shear rate|) from
    (Eqs. 7, 8, 10)

        L_i = sum_j V (v_j - v_i) grad W_ij + gamma' sum_k V_k (v_k - v_i) grad W_ik

    with the rest volume V = m/rho_0 for m/rho_j: equal to within the compression, and known in
    the same pass.  Reads: position, velocity.  Writes: density, pressure_term, viscosity.
    """
    rest_density = ti.static(fluid.equation_of_state.rest_density)
    mass = ti.static(fluid.calibration.mass)
    for i in range(p.count[None]):
        x_i = p.position[i]
        v_i = p.velocity[i]
        blood = fluid.kernel.w(0.0)
        gradient = ti.Matrix.zero(float, 3, 3)
        for n in range(nb.blood_count[i]):
            j = nb.blood_index[i, n]
            r_ij = nb.grid.separation(x_i, p.position[j])
            r = r_ij.norm()
            blood += fluid.kernel.w(r)
            if ti.static(fluid.rheology.shear_dependent and not fluid.nested):
                gradient += (fluid.kernel.slope(r) * (p.velocity[j] - v_i)).outer_product(r_ij)
        gradient *= ti.static(fluid.calibration.gradient * mass / rest_density)
        behind = 0.0
        for n in range(nb.wall_count[i]):
            k = nb.wall_index[i, n]
            r_ik = nb.grid.separation(x_i, w.position[k])
            r = r_ik.norm()
            behind += w.volume[k] * fluid.kernel.w(r)
            if ti.static(fluid.rheology.shear_dependent and not fluid.nested):
                factor = ti.static(fluid.calibration.gradient * fluid.calibration.wall_gradient)
                v_ik = v_i - wall_velocity(w, k)
                gradient -= (factor * w.volume[k] * fluid.kernel.slope(r) * v_ik).outer_product(
                    r_ik
                )
        rho = mass * blood + ti.static(fluid.calibration.wall_density * rest_density) * behind
        p.density[i] = rho
        pressure_term[i] = fluid.equation_of_state.pressure(rho) / (rho * rho)
        viscosity[i] = fluid.rheology.viscosity(shear_rate(gradient))


@ti.func
def shear_rate(gradient):
    """sqrt(2 D:D) [1/s], D the symmetric, traceless part of the velocity gradient."""
    g = gradient + gradient.transpose()
    third = g.trace() / 3.0
    square = 0.0
    for a, b in ti.static(ti.ndrange(3, 3)):
        entry = g[a, b] - (third if ti.static(a == b) else 0.0)
        square += entry * entry
    return ti.sqrt(0.5 * square)


@ti.kernel
def force_on_tool(
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    pressure_term: ti.template(),
    viscosity: ti.template(),
) -> ti.math.vec3:
    """F = -m sum_i sum_k a_ik over the proxies of the tool [N], a_ik as in `sum_acceleration`.

    m is the blood that a particle stands for.
    """
    force = ti.Vector([0.0, 0.0, 0.0])
    for i in range(p.count[None]):
        for n in range(nb.wall_count[i]):
            k = nb.wall_index[i, n]
            if k >= w.count:
                r_ik = nb.grid.separation(p.position[i], w.position[k])
                force -= wall_pair_acceleration(
                    w, k, r_ik, p.velocity[i], p.density[i], pressure_term[i], viscosity[i], fluid
                )
    return ti.static(p.mass * fluid.equation_of_state.rest_density) * force


@ti.kernel
def sum_stress(
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    viscosity: ti.template(),
    stress: ti.template(),
):
    """tau_i = 2 mu D (Eqs. 6-8, 10; the printed factor 1/2 restored).

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


@ti.func
def wall_pair_acceleration(w: ti.template(), k, r_ik, v_i, rho_i, p_i, mu_i, fluid: ti.template()):
    """a_ik/rho_0 [m^4/(kg s^2)]: see `sum_acceleration`."""
    eps = ti.static(fluid.softening)
    r2 = r_ik.norm_sqr()
    slope = fluid.kernel.slope(ti.sqrt(r2))
    v_ik = v_i - wall_velocity(w, k)
    push = ti.static(fluid.calibration.gradient) * p_i
    if ti.static(fluid.artificial_viscosity > 0.0):
        push -= ti.static(fluid.signal) * ti.min(0.0, v_ik.dot(r_ik)) / ((r2 + eps) * rho_i)
    a_ik = -(ti.static(fluid.calibration.wall_density) * w.volume[k] * push * slope) * r_ik
    friction = ti.static(2.0 * fluid.calibration.wall_friction) * mu_i / (rho_i * rho_i)
    return a_ik + (w.volume[k] * friction * slope * r2 / (r2 + eps)) * v_ik


@ti.kernel
def sum_acceleration(
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    pressure_term: ti.template(),
    viscosity: ti.template(),
    stress: ti.template(),
    g_x: float,
    g_y: float,
    g_z: float,
):
    """Acceleration of each particle (Eqs. 5, 11-13, 15, 16, each per unit mass).

    Blood, Eq. 13 with Monaghan's artificial term (1992, eq. 4.1) and Morris' viscous form (1997):
        a_ij = -m (p_i/rho_i^2 + p_j/rho_j^2 + Pi_ij) grad W_ij
               + m 2 mu_ij/(rho_i rho_j) (r_ij . grad W_ij)/(r_ij^2 + eps) v_ij
    Wall, Eq. 15 with one p_i/rho_i^2 (see calibration), and Eq. 16's friction in the same form as
    between blood, mu_k = mu_i, rho_k = rho_i:
        a_ik = -gamma rho_0 V_k (p_i/rho_i^2 + Pi_ik) grad W_ik
               + gamma_mu rho_0 V_k 2 mu_i/rho_i^2 (r_ik . grad W_ik)/(r_ik^2 + eps) v_ik
    (Eq. 16 takes the part of v along r_ik: at a wall that lies to one side it would damp motion
    towards the wall some ten times harder than motion along it.)
    Both pressure forces carry the gradient's calibration.  mu_ij is the harmonic mean;
    Pi_ij = -alpha h_s c (v.r)/(r^2 + eps)/rho where v.r < 0, also at the wall.
    Reads: position, velocity, density, scratch.  Writes: acceleration.
    """
    mass = ti.static(fluid.calibration.mass)
    eps = ti.static(fluid.softening)
    for i in range(p.count[None]):
        x_i = p.position[i]
        v_i = p.velocity[i]
        rho_i = p.density[i]
        p_i = pressure_term[i]
        mu_i = viscosity[i]
        a_i = ti.Vector([0.0, 0.0, 0.0])
        for n in range(nb.blood_count[i]):
            j = nb.blood_index[i, n]
            r_ij = nb.grid.separation(x_i, p.position[j])
            r2 = r_ij.norm_sqr()
            slope = fluid.kernel.slope(ti.sqrt(r2))
            v_ij = v_i - p.velocity[j]
            rho_j = p.density[j]
            push = ti.static(fluid.calibration.gradient) * (p_i + pressure_term[j])
            if ti.static(fluid.artificial_viscosity > 0.0):
                approach = ti.min(0.0, v_ij.dot(r_ij)) / (r2 + eps)
                push -= ti.static(2.0 * fluid.signal) * approach / (rho_i + rho_j)
            a_i -= (push * slope) * r_ij
            if ti.static(fluid.nested):
                factor = ti.static(fluid.calibration.gradient)
                a_i += (factor * slope / (rho_i * rho_j)) * ((stress[i] + stress[j]) @ r_ij)
            else:
                mu_ij = mu_i
                if ti.static(fluid.rheology.shear_dependent):
                    mu_ij = 2.0 * mu_i * viscosity[j] / (mu_i + viscosity[j])
                factor = ti.static(2.0 * fluid.calibration.viscosity)
                a_i += (factor * mu_ij * slope * r2 / ((r2 + eps) * rho_i * rho_j)) * v_ij
        a_i *= mass
        wall = ti.Vector([0.0, 0.0, 0.0])
        for n in range(nb.wall_count[i]):
            k = nb.wall_index[i, n]
            r_ik = nb.grid.separation(x_i, w.position[k])
            wall += wall_pair_acceleration(w, k, r_ik, v_i, rho_i, p_i, mu_i, fluid)
        wall *= ti.static(fluid.equation_of_state.rest_density)
        # A vector as an argument would cost 0.05 ms a launch.
        p.acceleration[i] = a_i + wall + ti.Vector([g_x, g_y, g_z])
