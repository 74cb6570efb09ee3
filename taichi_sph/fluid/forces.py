"""Terms of the equation of motion between two particles: one function a term.

Each serves blood beside blood and blood beside the wall, the physics, the implicit model and the
network's pressure head, and the force on a tool.

| symbol | here | meaning | unit |
|---|---|---|---|
| r_ij, r^2 | r_ij, r2 | x_i - x_j, its square | m, m^2 |
| r^2 + eps | softened | keeps v.r/r^2 finite (Monaghan 1992) | m^2 |
| v_ij | v_ij | v_i - v_j | m/s |
| dW/dr / r | slope | slope r_ij is grad W_ij, so slope r^2 is r_ij.grad W_ij | 1/m^5 |
| p/rho^2 | pressure_term | of each particle | m^5/(kg s^2) |
| rho, mu | rho, mu | density, viscosity | kg/m^3, Pa s |
| tau | stress | viscous stress | Pa |
| V_k | w.volume | volume of a proxy (Eq. 3, gamma = 1) | m^3 |
| F_k | w.friction | factor of the friction where the wall is curved | 1 |

Arguments are plain: a Taichi struct would fix their precision when this file is imported, before
Taichi is started.
"""

import taichi as ti

from taichi_sph.fluid.shifting import surrounded
from taichi_sph.particles.wall import wall_velocity


@ti.func
def pair_pressure(fluid: ti.template(), pressure_term_i, pressure_term_j):
    """Pressure: p_i/rho_i^2 + p_j/rho_j^2, to be multiplied by -m grad W_ij (Eq. 13).

    It carries the gradient's calibration.  Unit: m^5/(kg s^2).
    """
    return ti.static(fluid.calibration.gradient) * (pressure_term_i + pressure_term_j)


@ti.func
def artificial_factor(fluid: ti.template(), sound_speed, density):
    """Factor alpha h_s c of the artificial viscosity where blood has a density [m^2/s].

    Thin blood, as `taichi_sph.fluid.shifting` has it, has its own alpha beside the scene's: nothing
    else keeps its particles from clumping, for they have no pressure.
    """
    scale = ti.static(fluid.kernel.smoothing_length) * sound_speed
    ratio = density * ti.static(1.0 / fluid.rest_density)
    thin = ti.static(fluid.thin_viscosity) * (1.0 - surrounded(ratio))
    return scale * (ti.static(fluid.artificial_viscosity) + thin)


@ti.func
def pair_artificial_viscosity(alpha, r_ij, v_ij, softened, density_sum):
    """Artificial viscosity Pi_ij, to be multiplied by -m grad W_ij (Monaghan 1992, eq. 4.1).

    Pi_ij = -2 alpha h_s c (v_ij.r_ij)/(r^2 + eps)/(rho_i + rho_j) for particles that approach each
    other, else 0; `alpha` is alpha h_s c.  Unit: m^5/(kg s^2).
    """
    return -2.0 * alpha * (ti.min(0.0, v_ij.dot(r_ij)) / softened) / density_sum


@ti.func
def pair_viscosity(twice_mu, slope, r2, softened, rho_i, rho_j):
    """Viscosity: 2 mu (r_ij.grad W_ij)/((r^2 + eps) rho_i rho_j), to be multiplied by m v_ij.

    Morris et al. 1997, doi:10.1006/jcph.1997.5776; `twice_mu` carries the calibration, another for
    blood than for the wall.  The print's Eq. 16 takes the part of v along r_ij: at a wall that lies
    to one side it would damp motion towards the wall some ten times harder than motion along it.
    Unit: 1/(kg s).
    """
    return twice_mu * slope * r2 / (softened * rho_i * rho_j)


@ti.func
def mean_viscosity(fluid: ti.template(), mu_i, mu_j):
    """Harmonic mean of two viscosities [Pa s], which keeps the stress continuous between them."""
    mu = mu_i
    if ti.static(fluid.rheology.shear_dependent):
        mu = 2.0 * mu_i * mu_j / (mu_i + mu_j)
    return mu


@ti.func
def pair_nested_stress(fluid: ti.template(), stress_sum, r_ij, slope, rho_i, rho_j):
    """Nested stress: (tau_i + tau_j).grad W_ij/(rho_i rho_j), to be multiplied by m (Eq. 12).

    It carries the gradient's calibration.  Unit: m/(kg s^2).
    """
    return (ti.static(fluid.calibration.gradient) * slope / (rho_i * rho_j)) * (stress_sum @ r_ij)


@ti.func
def wall_pair_acceleration(
    w: ti.template(), k, r_ik, v_i, rho_i, p_i, mu_i, fluid: ti.template(), sound_speed
):
    """Acceleration by a proxy over rho_0, a_ik/rho_0 (Eqs. 15 and 16) [m^4/(kg s^2)].

    a_ik = -gamma rho_0 V_k (p_i/rho_i^2 + Pi_ik) grad W_ik
           + gamma_mu rho_0 F_k V_k 2 mu_i/rho_i^2 (r_ik.grad W_ik)/(r_ik^2 + eps) v_ik

    The proxy has the density and viscosity of the particle and, unlike the print's, no pressure:
    see `taichi_sph.fluid.calibration`.  p_i is the particle's p/rho^2.
    """
    r2 = r_ik.norm_sqr()
    softened = r2 + ti.static(fluid.softening)
    slope = fluid.kernel.slope(ti.sqrt(r2))
    v_ik = v_i - wall_velocity(w, k)
    pressure = pair_pressure(fluid, p_i, 0.0)
    if ti.static(fluid.has_artificial_viscosity):
        # One quotient for two: rho_i + rho_k = 2 rho_i.
        alpha = artificial_factor(fluid, sound_speed, rho_i)
        pressure += pair_artificial_viscosity(alpha, r_ik, v_ik, softened * rho_i, 2.0)
    # The quotient by rho_i rho_k does not depend on k and leaves the loop.
    friction = ti.static(2.0 * fluid.calibration.wall_friction) * mu_i / (rho_i * rho_i)
    a_ik = -(ti.static(fluid.calibration.wall_density) * w.volume[k] * pressure * slope) * r_ik
    friction *= w.friction[k] * w.volume[k]
    return a_ik + pair_viscosity(friction, slope, r2, softened, 1.0, 1.0) * v_ik
