"""Sums over a particle's neighbours that begin every model: density, what changes it, dv/dx.

    rho_i/rho_0      = sum_j V W_ij + gamma sum_k V_k W_ik                           (Eq. 2)
    d(rho_i/rho_0)/dt = sum_j V v_ij.grad W_ij + gamma sum_k V_k v_ik.grad W_ik
    G_i              = sum_j V grad W_ij + gamma sum_k V_k grad W_ik
    D_i              = |G_i|^2 + sum_j |V grad W_ij|^2
    L_i              = sum_j V v_ji grad W_ij + gamma' sum_k V_k v_ki grad W_ik      (Eqs. 7, 10)

D_i is how much the density answers to a pressure of the particle itself (Bender and Koschier 2017,
doi:10.1109/TVCG.2016.2578335, eq. 9): the wall does not move away from it.

| symbol | here | meaning | unit |
|---|---|---|---|
| V | fluid.rest_volume | m/rho_0, the volume of a particle at rest density | m^3 |
| V_k | w.volume | volume of a proxy (Eq. 3 with gamma = 1) | m^3 |
| gamma | calibration.wall_density | of Eq. 3 | 1 |
| gamma' | calibration.wall_gradient | of Eq. 3, in L_i | 1 |
| r_ij, v_ij | r_ij, v_ij | x_i - x_j, v_i - v_j; v_ji = -v_ij | m, m/s |
| dW/dr / r | slope | slope r_ij is grad W_ij | 1/m^5 |

L_i carries the gradient's calibration.  V stands for m/rho_j: equal to within the compression, and
known in the same pass.
"""

import taichi as ti

from taichi_sph.particles.wall import wall_velocity


@ti.func
def pair_gradient(slope, r2, r, v):
    """Part of a neighbour in the sums over grad W = slope r: v.grad W, grad W and its square.

    r and v may be in any unit, r2 = r.r; the parts then are in it too.
    """
    return slope * v.dot(r), slope * r, slope * slope * r2


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
def density_sums(
    i,
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    unit: ti.template(),
    with_gradient: ti.template(),
    with_rate: ti.template(),
):
    """Density of particle i in a unit, its rate [1/s], D_i [1/m^2] and L_i [1/s].

    L_i is 0 unless `with_gradient`; the rate and D_i mean nothing unless `with_rate`: what nobody
    reads, the compiler leaves out.  Reads: position, velocity.
    """
    x_i = p.position[i]
    v_i = p.velocity[i]
    blood = fluid.kernel.w(0.0)
    blood_rate = 0.0
    blood_gradient = ti.Vector([0.0, 0.0, 0.0])
    square = 0.0
    gradient = ti.Matrix.zero(float, 3, 3)
    for n in range(nb.blood_count[i]):
        j = nb.blood_index[i, n]
        r_ij = nb.grid.separation(x_i, p.position[j])
        r2 = r_ij.norm_sqr()
        r = ti.sqrt(r2)
        slope = fluid.kernel.slope(r)
        v_ji = p.velocity[j] - v_i
        blood += fluid.kernel.w(r)
        rate_ji, gradient_ij, square_ij = pair_gradient(slope, r2, r_ij, v_ji)
        blood_rate -= rate_ji
        blood_gradient += gradient_ij
        square += square_ij
        if ti.static(with_gradient):
            gradient += (slope * v_ji).outer_product(r_ij)
    gradient *= ti.static(fluid.calibration.gradient * fluid.rest_volume)
    calibration = ti.static(fluid.calibration.gradient * fluid.calibration.wall_gradient)
    wall = 0.0
    wall_sum = ti.Vector([0.0, 0.0, 0.0])
    velocity_gradient = ti.Matrix.zero(float, 3, 3)
    for n in range(nb.wall_count[i]):
        k = nb.wall_index[i, n]
        r_ik = nb.grid.separation(x_i, w.position[k])
        r = r_ik.norm()
        wall += w.volume[k] * fluid.kernel.w(r)
        if ti.static(with_rate):
            # v_i leaves the loop: only where proxies move is there a velocity left in it.
            slope = w.volume[k] * fluid.kernel.slope(r)
            wall_sum += slope * r_ik
            if ti.static(w.moves):
                velocity_gradient += (slope * wall_velocity(w, k)).outer_product(r_ik)
        elif ti.static(with_gradient):
            v_ik = v_i - wall_velocity(w, k)
            slope = calibration * w.volume[k] * fluid.kernel.slope(r)
            gradient -= (slope * v_ik).outer_product(r_ik)
    velocity_gradient -= v_i.outer_product(wall_sum)
    if ti.static(with_gradient and with_rate):
        gradient += calibration * velocity_gradient
    return (
        density_of(fluid, unit, blood, wall),
        density_rate(fluid, blood_rate, -velocity_gradient.trace()),
        density_response(fluid, blood_gradient, wall_sum, square),
        gradient,
    )
