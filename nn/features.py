"""Particle state features: the 23 of the paper's section 2.1, and four more, of each particle.

| # | feature | definition | unit | seen by the network times |
|---|---|---|---|---|
| 0-2 | a_i | acceleration of the previous step (frame n) | m/s^2 | T^2/R |
| 3 | N | blood neighbours, 0 < r_ij < R | - | 1/N_0 |
| 4-6 | mean of r_j - r_i over blood (Eq. 19) | 0 for N = 0 | m | 1/R |
| 7-9 | mean of v_j - v_i over blood (Eq. 20) | 0 for N = 0 | m/s | 1/U |
| 10 | variance of r_ij = |r_i - r_j| (Eq. 21) | 0 for N = 0 | m^2 | 1/R^2 |
| 11 | variance of v_ij = |v_i - v_j| (Eq. 22) | 0 for N = 0 | m^2/s^2 | 1/U^2 |
| 12 | skewness of the binned r_ij (Eq. 23) | 0 where the bins' variance is 0 | - | 1 |
| 13 | skewness of the binned v_ij | likewise | - | 1 |
| 14 | kurtosis of the binned r_ij (Eq. 24) | likewise | - | 1 |
| 15 | kurtosis of the binned v_ij | likewise | - | 1 |
| 16 | M | proxies, r_ik < R | - | (wall spacing/d)^2/N_0 |
| 17-19 | mean of r_k - r_i over proxies | 0 for M = 0 | m | 1/R |
| 20 | variance of r_ik | 0 for M = 0 | m^2 | 1/R^2 |
| 21 | skewness of the binned r_ik | 0 where the bins' variance is 0 | - | 1 |
| 22 | kurtosis of the binned r_ik | likewise | - | 1 |
| 23 | compression | max(rho/rho_0 - 1, 0): density is not among the paper's | - | 50 |
| 24 | divergence | div v, the rate at which that density falls | 1/s | T |
| 25 | rho/rho_0 | by Eq. 2; no network sees it | - | 1 |
| 26 | response | D of `taichi_sph.fluid.density`; no network sees it | 1/m^2 | R^2 |

T is the frame interval, R the support radius, N_0 the neighbours of a lattice and U the speed that
the bins of v_ij span.  The six bins of a distance span [0, R] as printed, l_b = b R/6.  The paper
does not say what those of a speed span.  Here [0, U] with U a fortieth of the sound speed, a
quarter of the largest speed that the scene's drop allows: neighbours share most of their motion,
and a wider span would leave all of them in the first bin.  The last bin takes what is faster.
Skewness and kurtosis do not depend on the scale of l_b, so power sums of the bin numbers replace
the histogram: they are exact in single precision.
"""

import math
from dataclasses import dataclass

import taichi as ti

from taichi_sph.fluid.density import (
    calibrated_gradient,
    density_of,
    density_rate,
    density_response,
    pair_crowding,
)
from taichi_sph.fluid.rheology import shear_rate
from taichi_sph.fluid.shifting import shifting_velocity
from taichi_sph.particles.wall import wall_velocity

ACCELERATION, NEIGHBOURS, POSITION, VELOCITY = 0, 3, 4, 7
DISTANCE_VARIANCE, SPEED_VARIANCE = 10, 11
DISTANCE_SKEWNESS, SPEED_SKEWNESS, DISTANCE_KURTOSIS, SPEED_KURTOSIS = 12, 13, 14, 15
PROXIES, PROXY_POSITION, PROXY_VARIANCE, PROXY_SKEWNESS, PROXY_KURTOSIS = 16, 17, 20, 21, 22
COMPRESSION, DIVERGENCE, DENSITY_RATIO, RESPONSE = 23, 24, 25, 26
"""Rows of the table above; those of vectors are the first of three."""

PAPER_COUNT = 23
"""Number of the paper's features, the first rows."""
NETWORK_COUNT = 25
"""Number of the features that a network may see."""
ROW_COUNT = 27
"""Number of all rows."""
BINS = 6
TABLE_VERSION = 2
"""Raised when a definition above changes; weights of another version are refused."""

NAMES = (
    "a_x", "a_y", "a_z", "N", "disx_b", "disy_b", "disz_b", "rvx_b", "rvy_b", "rvz_b",
    "D_dis_b", "D_rv_b", "alpha_dis_b", "alpha_rv_b", "beta_dis_b", "beta_rv_b",
    "M", "disx_p", "disy_p", "disz_p", "D_dis_p", "alpha_dis_p", "beta_dis_p",
    "compression", "divergence",
)  # fmt: skip


@ti.data_oriented
@dataclass(frozen=True)
class FeatureScales:
    """What the features are measured in."""

    support_radius: float
    """R [m]."""
    spacing: float
    """d [m]."""
    frame_interval: float
    """T at the start [s]; it goes with 1/c."""
    sound_speed: float
    """c at the start [m/s]."""
    wall_spacing_ratio: float = 1.0
    """Proxy spacing over d."""

    @property
    def speed(self) -> float:
        """U = c/40 [m/s]."""
        return self.sound_speed / 40.0

    @property
    def speed_limit(self) -> float:
        """R/T [m/s]: a neighbourhood crossed in one frame."""
        return self.support_radius / self.frame_interval

    @property
    def acceleration(self) -> float:
        """R/T^2 [m/s^2]."""
        return self.support_radius / self.frame_interval**2

    @property
    def neighbours(self) -> float:
        """N_0: neighbours of a lattice, 4/3 pi (R/d)^3."""
        return 4.0 / 3.0 * math.pi * (self.support_radius / self.spacing) ** 3

    @property
    def proxies(self) -> float:
        """What M is divided by: N_0/(wall spacing/d)^2, so that a finer wall counts the same."""
        return self.neighbours / self.wall_spacing_ratio**2


@ti.data_oriented
@dataclass(frozen=True)
class Inputs:
    """Which features a network sees; the kernels work out no others."""

    index: tuple[int, ...]
    """Rows of the table above, those of NETWORK_COUNT."""

    def among(self, *rows: int) -> bool:
        """Whether any of these rows is seen."""
        return any(row in self.index for row in rows)


ALL = Inputs(tuple(range(NETWORK_COUNT)))


@ti.func
def central_moments(n, s1, s2, s3, s4):
    """Skewness and kurtosis from power sums of n numbers; 0 where they do not vary."""
    skewness = 0.0
    kurtosis = 0.0
    if n > 0.0:
        # About the bin nearest to the mean first: exact, since all are small multiples of 1/16.
        b = ti.round(s1 / n + 0.5) - 0.5
        t1 = s1 - n * b
        t2 = s2 - b * (2.0 * s1 - n * b)
        t3 = s3 - b * (3.0 * s2 - b * (3.0 * s1 - n * b))
        t4 = s4 - b * (4.0 * s3 - b * (6.0 * s2 - b * (4.0 * s1 - n * b)))
        # n^2, n^3 and n^4 times the central moments: whole multiples still, nearly all exact.
        second = n * t2 - t1 * t1
        if second > 0.25:
            third = n * (n * t3 - 3.0 * t1 * t2) + 2.0 * t1 * t1 * t1
            fourth = n * (n * (n * t4 - 4.0 * t1 * t3) + 6.0 * t1 * t1 * t2) - 3.0 * t1**4
            skewness = third / (second * ti.sqrt(second))
            kurtosis = fourth / (second * second)
    return ti.Vector([skewness, kurtosis])


@ti.func
def bin_of(q):
    """Number of the bin of q in [0, 1), from the middle: -2.5, -1.5, ..., 2.5."""
    return ti.min(ti.floor(ti.static(float(BINS)) * q), ti.static(BINS - 1.0)) - ti.static(
        0.5 * (BINS - 1)
    )


@ti.func
def put_moments(f: ti.template(), skewness: ti.template(), kurtosis: ti.template(), n, s):
    """Write skewness and kurtosis into two rows, from the power sums of n bin numbers."""
    shape = central_moments(n, s[0], s[1], s[2], s[3])
    f[skewness] = shape[0]
    f[kurtosis] = shape[1]


@ti.func
def blood_features(
    f: ti.template(),
    i,
    p: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    scales: ti.template(),
    inputs: ti.template(),
    interval,
):
    """Write rows 3 to 15 of particle i; lengths in R, velocities in U.

    Returns: sum_j W_ij, W(0) included, sum_j v_ji grad W_ij, sum_j grad W_ji, sum_j |grad W_ij|^2
    and sum_j f_ij grad W_ji.
    """
    x_i = p.position[i]
    v_i = p.velocity[i]
    per_length = ti.static(1.0 / scales.support_radius)
    per_speed = interval * ti.static(1.0 / (scales.speed * scales.frame_interval))
    blood = fluid.kernel.w(0.0)
    velocity_gradient = ti.Matrix.zero(float, 3, 3)
    gradient = ti.Vector([0.0, 0.0, 0.0])
    concentration = ti.Vector([0.0, 0.0, 0.0])
    square = 0.0
    n = 0.0
    r_sum = ti.Vector([0.0, 0.0, 0.0])
    v_sum = ti.Vector([0.0, 0.0, 0.0])
    distance = ti.Vector([0.0, 0.0])
    speed = ti.Vector([0.0, 0.0])
    distance_bins = ti.Vector([0.0, 0.0, 0.0, 0.0])
    speed_bins = ti.Vector([0.0, 0.0, 0.0, 0.0])
    for k in range(nb.blood_count[i]):
        j = nb.blood_index[i, k]
        r_ji = -nb.grid.separation(x_i, p.position[j]) * per_length
        q = r_ji.norm()
        if q < 1.0:
            v_ji = (p.velocity[j] - v_i) * per_speed
            n += 1.0
            r = q * ti.static(scales.support_radius)
            w_ij = fluid.kernel.w(r)
            blood += w_ij
            gradient_ji = fluid.kernel.slope(r) * r_ji
            velocity_gradient -= v_ji.outer_product(gradient_ji)
            concentration += pair_crowding(fluid, w_ij) * gradient_ji
            gradient += gradient_ji
            square += gradient_ji.norm_sqr()
            if ti.static(inputs.among(POSITION, POSITION + 1, POSITION + 2)):
                r_sum += r_ji
            if ti.static(inputs.among(VELOCITY, VELOCITY + 1, VELOCITY + 2)):
                v_sum += v_ji
            if ti.static(inputs.among(DISTANCE_VARIANCE)):
                # From the middle of its range: the variance then loses no digits.
                distance += ti.Vector([q - 0.5, (q - 0.5) * (q - 0.5)])
            if ti.static(inputs.among(DISTANCE_SKEWNESS, DISTANCE_KURTOSIS)):
                b = bin_of(q)
                distance_bins += ti.Vector([b, b * b, b * b * b, b * b * b * b])
            if ti.static(inputs.among(SPEED_VARIANCE, SPEED_SKEWNESS, SPEED_KURTOSIS)):
                u = v_ji.norm()
                speed += ti.Vector([u, u * u])
                if ti.static(inputs.among(SPEED_SKEWNESS, SPEED_KURTOSIS)):
                    c = bin_of(u)
                    speed_bins += ti.Vector([c, c * c, c * c * c, c * c * c * c])
    if n > 0.0:
        f[NEIGHBOURS] = n * ti.static(1.0 / scales.neighbours)
        for a in ti.static(range(3)):
            f[POSITION + a] = r_sum[a] / n
            f[VELOCITY + a] = v_sum[a] / n
        f[DISTANCE_VARIANCE] = ti.max(0.0, distance[1] / n - (distance[0] / n) ** 2)
        f[SPEED_VARIANCE] = ti.max(0.0, speed[1] / n - (speed[0] / n) ** 2)
        if ti.static(inputs.among(DISTANCE_SKEWNESS, DISTANCE_KURTOSIS)):
            put_moments(f, DISTANCE_SKEWNESS, DISTANCE_KURTOSIS, n, distance_bins)
        if ti.static(inputs.among(SPEED_SKEWNESS, SPEED_KURTOSIS)):
            put_moments(f, SPEED_SKEWNESS, SPEED_KURTOSIS, n, speed_bins)
    return blood, velocity_gradient, gradient, square, concentration


@ti.func
def wall_features(
    f: ti.template(),
    i,
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    scales: ti.template(),
    inputs: ti.template(),
):
    """Write rows 16 to 22 of particle i; lengths in R.

    Returns: sum_k V_k W_ik, sum_k V_k v_ki grad W_ik with v_ki in m/s, and sum_k V_k grad W_ki.
    """
    x_i = p.position[i]
    wall = 0.0
    velocity_gradient = ti.Matrix.zero(float, 3, 3)
    gradient = ti.Vector([0.0, 0.0, 0.0])
    m = 0.0
    r_sum = ti.Vector([0.0, 0.0, 0.0])
    distance = ti.Vector([0.0, 0.0])
    bins = ti.Vector([0.0, 0.0, 0.0, 0.0])
    for n in range(nb.wall_count[i]):
        k = nb.wall_index[i, n]
        r_ki = -nb.grid.separation(x_i, w.position[k]) * ti.static(1.0 / scales.support_radius)
        q = r_ki.norm()
        if q < 1.0:
            m += 1.0
            r = q * ti.static(scales.support_radius)
            wall += w.volume[k] * fluid.kernel.w(r)
            slope = w.volume[k] * fluid.kernel.slope(r)
            gradient_k = slope * r_ki
            gradient += gradient_k
            if ti.static(w.moves):
                velocity_gradient -= wall_velocity(w, k).outer_product(gradient_k)
            if ti.static(inputs.among(PROXY_POSITION, PROXY_POSITION + 1, PROXY_POSITION + 2)):
                r_sum += r_ki
            if ti.static(inputs.among(PROXY_VARIANCE)):
                distance += ti.Vector([q - 0.5, (q - 0.5) * (q - 0.5)])
            if ti.static(inputs.among(PROXY_SKEWNESS, PROXY_KURTOSIS)):
                b = bin_of(q)
                bins += ti.Vector([b, b * b, b * b * b, b * b * b * b])
    if m > 0.0:
        f[PROXIES] = m * ti.static(1.0 / scales.proxies)
        for a in ti.static(range(3)):
            f[PROXY_POSITION + a] = r_sum[a] / m
        f[PROXY_VARIANCE] = ti.max(0.0, distance[1] / m - (distance[0] / m) ** 2)
        if ti.static(inputs.among(PROXY_SKEWNESS, PROXY_KURTOSIS)):
            put_moments(f, PROXY_SKEWNESS, PROXY_KURTOSIS, m, bins)
    return wall, velocity_gradient + p.velocity[i].outer_product(gradient), gradient


@ti.func
def features_of(
    i,
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    scales: ti.template(),
    inputs: ti.template(),
    interval,
):
    """All rows of the table for particle i, dimensionless (its last column); its shifting [m/s].

    Of the rows that a network may see, those that `inputs` leaves out are 0.
    Reads: position, velocity, acceleration.
    """
    f = ti.Vector([0.0] * ROW_COUNT)
    if ti.static(inputs.among(ACCELERATION, ACCELERATION + 1, ACCELERATION + 2)):
        a_i = p.acceleration[i] * (interval * interval * ti.static(1.0 / scales.support_radius))
        for a in ti.static(range(3)):
            f[ACCELERATION + a] = a_i[a]
    blood, blood_rates, blood_gradient, square, crowding = blood_features(
        f, i, p, nb, fluid, scales, inputs, interval
    )
    wall, wall_rates, wall_gradient = wall_features(f, i, p, w, nb, fluid, scales, inputs)
    f[DENSITY_RATIO] = density_of(fluid, fluid.rest_density, blood, wall)
    f[COMPRESSION] = 50.0 * ti.max(0.0, f[DENSITY_RATIO] - 1.0)
    # Lengths in the gradients are in R: each is R times what it gives, and R^2 D is R^4 times.
    radius = ti.static(scales.support_radius)
    blood_rates *= ti.static(scales.speed * scales.frame_interval) / interval
    rate = -density_rate(fluid, blood_rates.trace(), wall_rates.trace())
    f[DIVERGENCE] = -rate * ti.static(scales.support_radius) * interval
    sheared = radius * shear_rate(
        calibrated_gradient(fluid, fluid.calibration.wall_gradient, blood_rates, wall_rates)
    )
    concentration = -radius * calibrated_gradient(
        fluid, fluid.calibration.wall_concentration, crowding, wall_gradient
    )
    shifting = shifting_velocity(fluid, f[DENSITY_RATIO], sheared, concentration, 1.0 / interval)
    response = density_response(fluid, blood_gradient, wall_gradient, square)
    f[RESPONSE] = ti.static(scales.support_radius**4) * response
    return f, shifting


@ti.kernel
def extract(
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    scales: ti.template(),
    out: ti.types.ndarray(dtype=float, ndim=2),
):
    """What `features_of` gives, for every live particle.  Writes: out[identity, ROW_COUNT]."""
    for i in range(p.count[None]):
        f, _ = features_of(i, p, w, nb, fluid, scales, ALL, ti.static(scales.frame_interval))
        for k in ti.static(range(ROW_COUNT)):
            out[p.identity[i], k] = f[k]
