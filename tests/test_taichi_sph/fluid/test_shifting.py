"""Shifting: against brute force, where there must be none, and that it keeps particles even."""

import numpy as np
import pytest

from builders import (
    SPHERE,
    D,
    Prescribed,
    Setup,
    ball,
    cubic_lattice,
    jittered_lattice,
    make_fluid,
    periodic,
    plane,
    precision,
    sphere,
)
from taichi_sph.fluid.rheology import Casson

SUMS = {"f64": 1e-10, "f32": 2e-3}
"""Of the largest value: f32 loses digits where the sums over neighbours cancel."""
FLUID = make_fluid(rheology=Casson(3.5e-3, 5e-3, 7.0), damping=1.0)
SHEAR = 50.0
"""Rate of the shear [1/s]."""
LATTICE = {"f64": 1e-6, "f32": 1e-3}
"""Of the largest shifting, |D| h_s: what the calibration and rounding leave on a lattice."""


def sheared(x: np.ndarray) -> np.ndarray:
    return SHEAR * np.column_stack([x[:, 2], 0.0 * x[:, 0], 0.0 * x[:, 0]])


def shifting(stage: Setup) -> np.ndarray:
    stage.accelerate(FLUID)
    return stage.in_order(stage.particles.shifting)


def in_the_sphere() -> Setup:
    x = ball(np.random.default_rng(3), SPHERE - 0.2 * D)
    stage = sphere()
    stage.put(x, sheared(x))
    return stage


def in_a_box() -> Setup:
    x = jittered_lattice(np.random.default_rng(4), 0.1)
    stage = periodic()
    stage.put(x, sheared(x))
    return stage


@pytest.mark.parametrize("place", [in_the_sphere, in_a_box])
def test_shifting_is_down_the_concentrations_gradient(place):
    stage = place()
    found = shifting(stage)
    expected = stage.reference(FLUID).shifting(
        FLUID.shifting, 1.0 / FLUID.step_limits(FLUID.sound_speed, 0.0, 0.0).sound
    )
    assert np.abs(expected).max() > 0.1 * SHEAR * 0.5 * D
    np.testing.assert_allclose(
        found, expected, rtol=0, atol=SUMS[precision()] * np.abs(expected).max()
    )


def test_blood_at_rest_is_not_shifted():
    stage = in_a_box()
    stage.put(stage.in_order(stage.particles.position))
    assert np.abs(shifting(stage)).max() == 0.0


def test_blood_at_a_free_surface_is_not_shifted():
    stage = periodic()
    x = ball(np.random.default_rng(5), 2.5 * D) + 4.0 * D
    stage.put(x, sheared(x))
    found = shifting(stage)
    thin = stage.in_order(stage.particles.density) < 0.90 * FLUID.rest_density
    assert thin.sum() > 20
    assert np.abs(found[thin]).max() == 0.0


def test_a_lattice_is_even_and_so_is_its_first_layer_at_a_wall():
    stage = plane()
    x = cubic_lattice(8, 8, 5)
    stage.put(x, sheared(x))
    found = shifting(stage)
    # The upper two layers are near the lattice's end.
    below = x[:, 2] < 3.0 * D
    largest = SHEAR * FLUID.kernel.smoothing_length
    # On average over where blood stands before the proxies, as the calibration is.
    assert np.abs(found[x[:, 2] < D].mean(axis=0)).max() < 0.05 * largest
    bulk = below & (x[:, 2] > 2.0 * D)
    assert np.abs(found[bulk]).max() < LATTICE[precision()] * largest


def test_shifting_alone_makes_particles_even():
    stage = in_a_box()
    x = stage.in_order(stage.particles.position)
    box = np.array(stage.neighbors.grid.period)
    spread = []
    step = 0.1 / (FLUID.shifting * SHEAR)
    for _ in range(40):
        stage.put(x, sheared(x))
        w = shifting(stage)
        spread.append(stage.in_order(stage.particles.density).std())
        x = (x + step * w) % box
    assert spread[-1] < 0.5 * spread[0]


def test_the_integrator_shifts_positions_and_not_velocities():
    stage = in_a_box()
    p = stage.particles
    x, v = stage.in_order(p.position), stage.in_order(p.velocity)
    stage.simulation(Prescribed(np.zeros_like, 1.0)).step(1e-6)
    plain = stage.in_order(p.position)
    stage.put(x, v)
    stage.simulation(Prescribed(np.zeros_like, 1.0, (0.3, 0.0, 0.0))).step(1e-6)
    np.testing.assert_allclose(
        stage.in_order(p.position)[:, 0] - plain[:, 0], 0.3e-6, rtol=0, atol=1e-4 * D
    )
    np.testing.assert_array_equal(stage.in_order(p.velocity), v)
