"""The implicit pressure against brute force, its stability, and blood that stands under it."""

import itertools

import numpy as np
import pytest

from builders import DENSITY, SPHERE, D, R, ball, make_fluid, precision, sphere
from reference import Blood, wendland_gradient
from taichi_sph.fluid.implicit import (
    DAMPING,
    LARGEST_ADVECTIVE_CFL,
    RELAXATION,
    SMALLEST_DIAGONAL,
    STIFFNESS,
    ImplicitAcceleration,
)
from taichi_sph.fluid.rheology import Casson

CLOSE = {"f64": 1e-11, "f32": 1e-3}
"""Of the largest value; in f32 compressions of 1 % lose two digits, and rounds carry that on."""
GRAVITY = np.array((1.0, -2.0, -9.81))
INTERVAL = 2e-4
FLUID = make_fluid(rheology=Casson(3.5e-3, 5e-3, 7.0), alpha=0.05)


def response_of(grad: np.ndarray, wall: np.ndarray, share: float) -> np.ndarray:
    """D_i [1/m^2] of the gradients of blood (n, n, 3) and the sums over the wall (n, 3)."""
    one_sided = share * grad.sum(axis=1) + wall
    d = (one_sided**2).sum(axis=1) + share**2 * (grad**2).sum(axis=(1, 2))
    return np.maximum(d, SMALLEST_DIAGONAL / R**2)


def brute_force(blood: Blood, rounds: int) -> tuple[np.ndarray, float]:
    """By the module's two equations, every pair spelled out.

    Returns:
        accelerations [m/s^2], (n, 3), and the mean compression that is left after the step.
    """
    share = blood.mass / DENSITY
    gamma = blood.factors["wall_density"]
    wall = gamma * np.einsum("k,ika->ia", blood.volume, blood.grad_wall)
    scale = INTERVAL**2 * DENSITY * response_of(blood.grad, wall, share)

    def rate(v: np.ndarray) -> np.ndarray:
        v_ij = v[:, None] - v[None]
        return share * np.einsum("ija,ija->i", blood.grad, v_ij) + (wall * v).sum(axis=1)

    excess = blood.rho / DENSITY - 1.0
    q = np.maximum(0.0, STIFFNESS * excess + DAMPING * INTERVAL * rate(blood.v)) / scale
    for remaining in range(rounds, -1, -1):
        blood.p = q * blood.rho**2
        a = blood.acceleration(GRAVITY)
        after = excess + INTERVAL * rate(blood.v + INTERVAL * a)
        if remaining:
            q = np.maximum(0.0, q + RELAXATION * after / scale)
    return a, float(np.maximum(after, 0.0).mean())


@pytest.mark.parametrize("rounds", [0, 1, 3])
def test_guess_and_rounds_are_the_equations(rounds):
    generator = np.random.default_rng(rounds)
    x = ball(generator, SPHERE - 0.2 * D)
    stage = sphere()
    stage.put(x, np.roll(50.0 * x, 1, axis=1) + 0.03 * generator.normal(size=x.shape))
    stage.build()
    blood = stage.reference(FLUID)
    model = ImplicitAcceleration(FLUID, stage.particles.capacity, INTERVAL, rounds)
    model.accelerate(stage.particles, stage.wall, stage.neighbors, tuple(GRAVITY))
    found = stage.in_order(stage.particles.acceleration)
    expected, left = brute_force(blood, rounds)
    assert 0.1 < np.mean(blood.p > 0.0) < 1.0
    assert np.abs(found - expected).max() < CLOSE[precision()] * np.abs(expected).max()
    if rounds:  # and rounds do what they are for
        guessed, left_by_guess = brute_force(blood, 0)
        assert np.abs(expected - guessed).max() > 0.01 * np.abs(expected).max()
        assert left < 0.9 * left_by_guess


def largest_response() -> float:
    """Largest eigenvalue of v -> D^-1 grad div v on clouds from even to disordered."""
    factors = FLUID.calibration
    largest = []
    for disorder in (0.0, 0.1, 0.2, 0.3):
        generator = np.random.default_rng(8)
        n = 8
        lattice = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 3)
        x = (lattice + disorder * generator.normal(size=lattice.shape)) * D
        r = x[:, None] - x[None]
        r -= n * D * np.round(r / (n * D))
        grad = wendland_gradient(r, R)  # none of a particle with itself
        share = factors.mass / DENSITY
        response = response_of(grad, np.zeros((len(x), 3)), share)
        v = generator.normal(size=x.shape)
        g = share * grad
        for _ in range(200):
            rate = np.einsum("ija,ia->i", g, v) - np.einsum("ija,ja->i", g, v)
            p = rate / response
            a = -factors.gradient * np.einsum("ija,ij->ia", g, p[:, None] + p[None])
            growth = -(a * v).sum() / (v**2).sum()
            v = a / np.linalg.norm(a)
        largest.append(growth)
    return max(largest)


def test_a_step_is_stable_for_any_mode_of_any_guess_with_any_rounds():
    """Compression c and its change u = -T div v obey u' = u - s (K c + G u), c' = c + u'."""
    top = largest_response()
    assert 3.0 < top < 3.9
    factors = [(0, k, g) for k in (0.0, 0.4, 0.8) for g in (0.0, 0.1)]
    factors += [
        (rounds, k, g)
        for rounds, k, g in itertools.product(
            (1, 2, 3, 10), np.linspace(0.0, STIFFNESS, 5), np.linspace(0.0, DAMPING, 4)
        )
    ]
    for rounds, k, g in factors:
        for s in np.linspace(0.0, 3.9, 60):
            big_k, big_g = k, g
            for _ in range(rounds):
                big_k = big_k * (1.0 - RELAXATION * s) + RELAXATION
                big_g = big_g * (1.0 - RELAXATION * s) + RELAXATION
            step = np.array([[1.0 - s * big_k, 1.0 - s * big_g], [-s * big_k, 1.0 - s * big_g]])
            assert np.abs(np.linalg.eigvals(step)).max() < 1.0 + 1e-6, (rounds, k, g, s)


def test_the_step_shortens_for_fast_blood():
    model = ImplicitAcceleration(FLUID, 8, INTERVAL)
    assert model.stable_step(0.0, 1e9) == INTERVAL
    assert model.stable_step(0.1 * R / INTERVAL, 1e9) == INTERVAL
    fast = 4.0 * R / INTERVAL
    assert model.stable_step(fast, 1e9) * fast == pytest.approx(
        LARGEST_ADVECTIVE_CFL * R, rel=1e-12
    )
