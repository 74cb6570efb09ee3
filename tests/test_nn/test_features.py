"""The 23 features against numpy histograms, and the network against torch's twin in numpy."""

import numpy as np
import pytest

from builders import (
    DENSITY,
    WALL_SPACING,
    D,
    R,
    precision,
    sphere,
)
from clouds import FLUID, SCALES, cloud, extracted
from nn.features import (
    BINS,
    COMPRESSION,
    DENSITY_RATIO,
    DIVERGENCE,
    NAMES,
    PAPER_COUNT,
    RESPONSE,
    FeatureScales,
)

CLOSE = {"f64": 1e-10, "f32": 1e-5}
"""Of each feature's largest value; single precision has seven digits."""
EDGE = 1e-5
"""Values this near to the edge of a bin may fall on its other side when rounded."""


def shape(values: np.ndarray) -> tuple[float, float]:
    """Skewness and kurtosis of the frequencies of six bins, Eqs. 23 and 24."""
    frequency, _ = np.histogram(np.minimum(values, 1.0 - 1e-12), bins=BINS, range=(0.0, 1.0))
    if np.count_nonzero(frequency) < 2:
        return 0.0, 0.0
    l = np.arange(1, BINS + 1) / BINS
    n = frequency.sum()
    deviation = l - (l * frequency).sum() / n
    sigma = np.sqrt((deviation**2 * frequency).sum() / n)
    return (
        (deviation**3 * frequency).sum() / (sigma**3 * n),
        (deviation**4 * frequency).sum() / (sigma**4 * n),
    )


def features_of(x, v, a, y) -> tuple[np.ndarray, np.ndarray]:
    """Features by brute force, (n, 23), and whether rounding could change a bin, (n,)."""
    rows, doubtful = np.zeros((len(x), PAPER_COUNT)), np.zeros(len(x), bool)
    for i in range(len(x)):
        f = rows[i]
        f[0:3] = a[i] / SCALES.acceleration
        r, u = (x - x[i]) / R, (v - v[i]) / SCALES.speed
        q = np.linalg.norm(r, axis=1)
        near = (q < 1.0) & (np.arange(len(x)) != i)
        r, u, q = r[near], u[near], q[near]
        s = np.linalg.norm(u, axis=1)
        edges = [q, s]
        if len(q):
            f[3] = len(q) / SCALES.neighbours
            f[4:7], f[7:10] = r.mean(axis=0), u.mean(axis=0)
            f[10], f[11] = q.var(), s.var()
            (f[12], f[14]), (f[13], f[15]) = shape(q), shape(s)
        r = (y - x[i]) / R
        q = np.linalg.norm(r, axis=1)
        r, q = r[q < 1.0], q[q < 1.0]
        edges.append(q)
        if len(q):
            f[16] = len(q) / SCALES.proxies
            f[17:20], f[20] = r.mean(axis=0), q.var()
            f[21], f[22] = shape(q)
        values = np.concatenate(edges) * BINS
        doubtful[i] = len(values) > 0 and np.abs(values - np.rint(values)).min() < EDGE
    return rows, doubtful


@pytest.mark.parametrize("seed", [0, 1])
def test_features_are_the_papers_statistics(seed):
    stage = cloud(seed)
    particles = stage.particles
    x, v, a = map(stage.in_order, (particles.position, particles.velocity, particles.acceleration))
    y = stage.wall.position.to_numpy()[: stage.wall.count].astype(float)
    expected, doubtful = features_of(x, v, a, y)
    found = extracted(stage)[:, :PAPER_COUNT]
    assert doubtful.mean() < 0.2
    for k, name in enumerate(NAMES[:PAPER_COUNT]):
        largest = np.abs(expected[:, k]).max()
        assert largest > 0.0, name
        difference = np.abs(found[:, k] - expected[:, k])[~doubtful].max()
        assert difference < CLOSE[precision()] * largest, name


def test_density_beside_the_features_is_equation_2():
    stage = cloud(2)
    density = stage.reference(FLUID).rho / DENSITY
    found = extracted(stage)
    np.testing.assert_allclose(found[:, DENSITY_RATIO], density, rtol=CLOSE[precision()])
    np.testing.assert_allclose(
        found[:, COMPRESSION], 50.0 * np.maximum(density - 1.0, 0.0), atol=5e3 * CLOSE[precision()]
    )


def test_response_is_what_a_particles_own_pressure_does_to_its_density():
    stage = cloud(4)
    fluid = stage.reference(FLUID)
    found = extracted(stage)[:, RESPONSE]
    blood = fluid.spacing_volume * fluid.grad
    wall = FLUID.calibration.wall_density * fluid.volume[:, None] * fluid.grad_wall
    whole = blood.sum(axis=1) + wall.sum(axis=1)
    # A pressure of i moves i by -whole_i and each j by blood_ij; the density of i answers with
    # whole_i . (its own way) - sum_j blood_ij . (j's way).
    change = -(whole**2).sum(axis=1) - (blood**2).sum(axis=(1, 2))
    np.testing.assert_allclose(found, -change * R**2, rtol=20.0 * CLOSE[precision()])


def test_features_do_not_depend_on_the_unit_of_length():
    """A vessel twice as large whose sound needs twice the time to cross a neighbourhood."""
    double = FeatureScales(
        2.0 * R, 2.0 * D, 2.0 * SCALES.frame_interval, SCALES.sound_speed, WALL_SPACING / D
    )
    assert double.speed == SCALES.speed
    assert double.neighbours == SCALES.neighbours
    assert double.proxies == SCALES.proxies
    assert double.speed_limit == SCALES.speed_limit
    assert double.acceleration == 0.5 * SCALES.acceleration


def test_divergence_is_the_rate_at_which_density_falls():
    stage = cloud(3)
    particles = stage.particles
    x, v = map(stage.in_order, (particles.position, particles.velocity))
    a = stage.in_order(particles.acceleration)
    before = extracted(stage)
    dt = 1e-6
    densities = []
    for sign in (1.0, -1.0):
        stage.put(x + sign * dt * v, v)
        stage.build()
        densities.append(stage.reference(FLUID).rho / DENSITY)
    rate = (densities[0] - densities[1]) / (2.0 * dt)
    assert np.abs(a).max() > 0.0
    scale = np.abs(rate).max()
    error = np.abs(before[:, DIVERGENCE] / SCALES.frame_interval + rate).max()
    # The difference's own rounding in f32: 1e-7 over 2e-6 s.
    assert error < {"f64": 1e-4 * scale, "f32": 0.2 + 1e-2 * scale}[precision()]


def test_a_lone_particle_has_finite_features_and_no_neighbours():
    stage = sphere()
    stage.put(np.zeros((1, 3)))
    stage.build()
    found = extracted(stage)[0]
    assert np.isfinite(found).all()
    assert np.all(found[:PAPER_COUNT] == 0.0)
