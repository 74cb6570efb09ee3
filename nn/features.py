"""The particle state features of the paper's section 2.1: 23 numbers a blood particle.

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

from taichi_sph.particles.wall import wall_velocity

COUNT = 23
EXTENDED = 25
"""With two more, for density is not among the paper's: 50 max(rho/rho_0 - 1, 0) and T div v."""
GATHERED = 27
"""With what no network sees: rho/rho_0 and the response of the density (see `features_of`)."""
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
    """T [s]."""
    sound_speed: float
    """c [m/s]."""
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
    """Rows of the table above, then compression and divergence."""

    def among(self, *rows: int) -> bool:
        """Whether any of these rows is seen."""
        return any(row in self.index for row in rows)


ALL = Inputs(tuple(range(EXTENDED)))


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
def features_of(
    i,
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    scales: ti.template(),
    inputs: ti.template(),
):
    """The 23 features of particle i, dimensionless (last column of the table), and four more.

    The four are 50 max(rho/rho_0 - 1, 0) by Eq. 2, T div v (the rate at which that density falls),
    and, which no network sees, rho/rho_0 and R^2 (|sum_j G_j|^2 + sum_j |G_j|^2): how much the
    density answers to a pressure of the particle itself, with G = grad W m/rho_0, the wall's in the
    first sum only (Bender and Koschier 2017, doi:10.1109/TVCG.2016.2578335, eq. 9).
    What `inputs` leaves out is 0.  Reads: position, velocity, acceleration.
    """
    f = ti.Vector([0.0] * GATHERED)
    x_i = p.position[i]
    v_i = p.velocity[i]
    if ti.static(inputs.among(0, 1, 2)):
        a_i = p.acceleration[i] * ti.static(1.0 / scales.acceleration)
        for a in ti.static(range(3)):
            f[a] = a_i[a]
    per_length = ti.static(1.0 / scales.support_radius)
    per_speed = ti.static(1.0 / scales.speed)

    blood = fluid.kernel.w(0.0)
    blood_rate = 0.0
    gradient = ti.Vector([0.0, 0.0, 0.0])
    gradient2 = 0.0
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
            blood += fluid.kernel.w(r)
            slope = fluid.kernel.slope(r)
            blood_rate += slope * v_ji.dot(r_ji)
            gradient += slope * r_ji
            gradient2 += (slope * q) ** 2
            if ti.static(inputs.among(4, 5, 6)):
                r_sum += r_ji
            if ti.static(inputs.among(7, 8, 9)):
                v_sum += v_ji
            if ti.static(inputs.among(10)):
                # From the middle of its range: the variance then loses no digits.
                distance += ti.Vector([q - 0.5, (q - 0.5) * (q - 0.5)])
            if ti.static(inputs.among(12, 14)):
                b = bin_of(q)
                distance_bins += ti.Vector([b, b * b, b * b * b, b * b * b * b])
            if ti.static(inputs.among(11, 13, 15)):
                u = v_ji.norm()
                speed += ti.Vector([u, u * u])
                if ti.static(inputs.among(13, 15)):
                    c = bin_of(u)
                    speed_bins += ti.Vector([c, c * c, c * c * c, c * c * c * c])
    if n > 0.0:
        f[3] = n * ti.static(1.0 / scales.neighbours)
        for a in ti.static(range(3)):
            f[4 + a] = r_sum[a] / n
            f[7 + a] = v_sum[a] / n
        f[10] = ti.max(0.0, distance[1] / n - (distance[0] / n) ** 2)
        f[11] = ti.max(0.0, speed[1] / n - (speed[0] / n) ** 2)
        if ti.static(inputs.among(12, 14)):
            s = distance_bins
            shape = central_moments(n, s[0], s[1], s[2], s[3])
            f[12] = shape[0]
            f[14] = shape[1]
        if ti.static(inputs.among(13, 15)):
            s2 = speed_bins
            shape2 = central_moments(n, s2[0], s2[1], s2[2], s2[3])
            f[13] = shape2[0]
            f[15] = shape2[1]

    behind = 0.0
    wall_gradient = ti.Vector([0.0, 0.0, 0.0])
    wall_rate = 0.0
    m = 0.0
    wall_sum = ti.Vector([0.0, 0.0, 0.0])
    wall_distance = ti.Vector([0.0, 0.0])
    wall_bins = ti.Vector([0.0, 0.0, 0.0, 0.0])
    for k in range(nb.wall_count[i]):
        kk = nb.wall_index[i, k]
        r_ki = -nb.grid.separation(x_i, w.position[kk]) * per_length
        q = r_ki.norm()
        if q < 1.0:
            m += 1.0
            r = q * ti.static(scales.support_radius)
            behind += w.volume[kk] * fluid.kernel.w(r)
            wall_gradient += (w.volume[kk] * fluid.kernel.slope(r)) * r_ki
            if ti.static(w.moves):
                slope = w.volume[kk] * fluid.kernel.slope(r)
                wall_rate += slope * wall_velocity(w, kk).dot(r_ki)
            if ti.static(inputs.among(17, 18, 19)):
                wall_sum += r_ki
            if ti.static(inputs.among(20)):
                wall_distance += ti.Vector([q - 0.5, (q - 0.5) * (q - 0.5)])
            if ti.static(inputs.among(21, 22)):
                b = bin_of(q)
                wall_bins += ti.Vector([b, b * b, b * b * b, b * b * b * b])
    if m > 0.0:
        f[16] = m * ti.static(1.0 / scales.proxies)
        for a in ti.static(range(3)):
            f[17 + a] = wall_sum[a] / m
        f[20] = ti.max(0.0, wall_distance[1] / m - (wall_distance[0] / m) ** 2)
        if ti.static(inputs.among(21, 22)):
            s3 = wall_bins
            shape3 = central_moments(m, s3[0], s3[1], s3[2], s3[3])
            f[21] = shape3[0]
            f[22] = shape3[1]
    # d(rho_i)/dt = sum_j m slope r_ij.v_ij, and r_ij.v_ij = r_ji.v_ji.
    share = ti.static(fluid.calibration.mass / fluid.equation_of_state.rest_density)
    gamma = ti.static(fluid.calibration.wall_density)
    f[25] = share * blood + gamma * behind
    f[23] = 50.0 * ti.max(0.0, f[25] - 1.0)
    rate = share * blood_rate * ti.static(scales.speed)
    rate += gamma * (wall_rate - v_i.dot(wall_gradient))
    f[24] = -rate * ti.static(scales.support_radius * scales.frame_interval)
    one_sided = share * gradient + gamma * wall_gradient
    f[26] = ti.static(scales.support_radius**4) * (one_sided.norm_sqr() + share**2 * gradient2)
    return f


@ti.kernel
def extract(
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    scales: ti.template(),
    out: ti.types.ndarray(dtype=float, ndim=2),
):
    """What `features_of` gives, for every live particle.  Writes: out[identity, 27]."""
    for i in range(p.count[None]):
        f = features_of(i, p, w, nb, fluid, scales, ALL)
        for k in ti.static(range(GATHERED)):
            out[p.identity[i], k] = f[k]
