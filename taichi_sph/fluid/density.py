"""Sums over a particle's neighbours that begin every model: density, what changes it, its order.

    rho_i/rho_0      = sum_j V W_ij + gamma sum_k V_k W_ik                           (Eq. 2)
    d(rho_i/rho_0)/dt = sum_j V v_ij.grad W_ij + gamma sum_k V_k v_ik.grad W_ik
    G_i              = sum_j V grad W_ij + gamma sum_k V_k grad W_ik
    D_i              = |G_i|^2 + sum_j |V grad W_ij|^2
    L_i              = sum_j V v_ji grad W_ij + gamma' sum_k V_k v_ki grad W_ik      (Eqs. 7, 10)
    C_i              = sum_j V f_ij grad W_ij + gamma'' sum_k V_k grad W_ik

D_i is how much the density answers to a pressure of the particle itself (Bender and Koschier 2017,
doi:10.1109/TVCG.2016.2578335, eq. 9): the wall does not move away from it.
C_i is the gradient of the concentration of particles (Lind et al. 2012,
doi:10.1016/j.jcp.2011.10.027) with f_ij = 1 + 0.2 (W_ij/W(d))^4, which parts close pairs (Sun et
al. 2017, doi:10.1016/j.cma.2016.10.028); see `taichi_sph.fluid.shifting`.

| symbol | here | meaning | unit |
|---|---|---|---|
| V | fluid.rest_volume | m/rho_0, the volume of a particle at rest density | m^3 |
| V_k | w.volume | volume of a proxy (Eq. 3 with gamma = 1) | m^3 |
| gamma | calibration.wall_density | of Eq. 3 | 1 |
| gamma' | calibration.wall_gradient | of Eq. 3, in L_i | 1 |
| gamma'' | calibration.wall_concentration | of Eq. 3, in C_i | 1 |
| r_ij, v_ij | r_ij, v_ij | x_i - x_j, v_i - v_j; v_ji = -v_ij | m, m/s |
| dW/dr / r | slope | slope r_ij is grad W_ij | 1/m^5 |

L_i and C_i carry the gradient's calibration.  V stands for m/rho_j: equal to within the
compression, and known in the same pass.
"""

import taichi as ti

from taichi_sph.fluid.calibration import CROWDING
from taichi_sph.particles.wall import wall_velocity


@ti.func
def density_of(fluid: ti.template(), unit: ti.template(), blood, wall):
    """Density from sum_j W_ij and sum_k V_k W_ik in a unit [kg/m^3]: rho_0 gives rho/rho_0.

    To divide afterwards would round once more.
    """
    return (
        ti.static(fluid.calibration.mass / unit) * blood
        + ti.static(fluid.calibration.wall_density * (fluid.rest_density / unit)) * wall
    )


@ti.func
def density_rate(fluid: ti.template(), blood, wall):
    """Rate d(rho/rho_0)/dt from sum_j v_ij.grad W_ij and sum_k V_k v_ik.grad W_ik [1/s]."""
    return ti.static(fluid.rest_volume) * blood + ti.static(fluid.calibration.wall_density) * wall


@ti.func
def density_response(fluid: ti.template(), blood, wall, square):
    """Response D_i from sum_j grad W_ij, sum_k V_k grad W_ik and sum_j |grad W_ij|^2 [1/m^2]."""
    volume = ti.static(fluid.rest_volume)
    one_sided = volume * blood + ti.static(fluid.calibration.wall_density) * wall
    return one_sided.norm_sqr() + volume * volume * square


@ti.func
def pair_crowding(fluid: ti.template(), w_ij):
    """Factor f_ij = 1 + 0.2 (W_ij/W(d))^4 of a pair in the concentration's gradient."""
    near = w_ij * ti.static(1.0 / float(fluid.kernel.w_of(fluid.spacing)))
    return 1.0 + ti.static(CROWDING) * near * near * near * near


@ti.func
def calibrated_gradient(fluid: ti.template(), gamma: ti.template(), blood, wall):
    """L_i from sum_j v_ji grad W_ij and sum_k V_k v_ki grad W_ik [1/s] with gamma', or C_i.

    C_i [1/m] is of sum_j f_ij grad W_ij and sum_k V_k grad W_ik with gamma''.
    """
    return (
        ti.static(fluid.calibration.gradient * fluid.rest_volume) * blood
        + ti.static(fluid.calibration.gradient * gamma) * wall
    )


@ti.func
def density_sums(
    i,
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    unit: ti.template(),
):
    """Density of particle i in a unit, its rate [1/s], D_i [1/m^2], L_i [1/s] and C_i [1/m].

    What nobody reads, the compiler leaves out.  Reads: position, velocity.
    """
    x_i = p.position[i]
    v_i = p.velocity[i]
    blood = fluid.kernel.w(0.0)
    blood_gradient = ti.Vector([0.0, 0.0, 0.0])
    square = 0.0
    gradient = ti.Matrix.zero(float, 3, 3)
    concentration = ti.Vector([0.0, 0.0, 0.0])
    for n in range(nb.blood_count[i]):
        j = nb.blood_index[i, n]
        r_ij = nb.grid.separation(x_i, p.position[j])
        r = r_ij.norm()
        slope = fluid.kernel.slope(r)
        w_ij = fluid.kernel.w(r)
        v_ji = p.velocity[j] - v_i
        blood += w_ij
        gradient_ij = slope * r_ij
        blood_gradient += gradient_ij
        square += gradient_ij.norm_sqr()
        gradient += v_ji.outer_product(gradient_ij)
        concentration += pair_crowding(fluid, w_ij) * gradient_ij
    wall = 0.0
    wall_sum = ti.Vector([0.0, 0.0, 0.0])
    velocity_gradient = ti.Matrix.zero(float, 3, 3)
    for n in range(nb.wall_count[i]):
        k = nb.wall_index[i, n]
        r_ik = nb.grid.separation(x_i, w.position[k])
        r = r_ik.norm()
        wall += w.volume[k] * fluid.kernel.w(r)
        # v_i leaves the loop: only where proxies move is there a velocity left in it.
        slope = w.volume[k] * fluid.kernel.slope(r)
        wall_sum += slope * r_ik
        if ti.static(w.moves):
            velocity_gradient += (slope * wall_velocity(w, k)).outer_product(r_ik)
    velocity_gradient -= v_i.outer_product(wall_sum)
    return (
        density_of(fluid, unit, blood, wall),
        density_rate(fluid, -gradient.trace(), -velocity_gradient.trace()),
        density_response(fluid, blood_gradient, wall_sum, square),
        calibrated_gradient(fluid, fluid.calibration.wall_gradient, gradient, velocity_gradient),
        calibrated_gradient(fluid, fluid.calibration.wall_concentration, concentration, wall_sum),
    )
