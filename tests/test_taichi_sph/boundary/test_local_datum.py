"""Local datum: what it takes from the sums, and where there is none."""

import numpy as np
import pytest

from driven_tube import LENGTH, drive
from taichi_sph.fluid.local_datum import LOCAL_SHARE
from taichi_sph.fluid.wcsph import sum_acceleration

LEVEL = 0.02
"""Of p/rho^2 [m^5/(kg s^2)]."""
ROUNDING = {"f64": 1e-12, "f32": 1e-5}
"""Of the pressure's acceleration: what cancels leaves its last digits."""
SUMS = {"f64": 1e-12, "f32": 1e-5}


@pytest.fixture
def flowing(driven):
    """The tube between two reservoirs, with blood that flows."""
    driven.time = 0.0
    driven.reset()
    drive(driven, "top", pressure=60.0)
    drive(driven, "bottom", pressure=20.0)
    for _ in range(30):
        driven.step(1.0)
    return driven


def pressure_forces(sim, datum: float) -> np.ndarray:
    """Accelerations under one pressure everywhere, rest density and a local datum [m/s^2]."""
    p, model = sim.particles, sim.model
    sim.neighbors.build(p, sim.wall)
    p.velocity.fill(0.0)
    p.density.fill(model.fluid.rest_density)
    p.local_datum.fill(datum)
    model.pressure_term.fill(LEVEL)
    sum_acceleration(
        p, sim.wall, sim.neighbors, model.fluid, model.pressure_term, model.viscosity,
        model.stress, model.sound_speed, 0.0, 0.0, 0.0,
    )  # fmt: skip
    return p.in_order(p.acceleration).astype(float)


def test_a_pressure_that_is_the_local_datum_pushes_no_particle(flowing, precision):
    whole = np.abs(pressure_forces(flowing, 0.0)).max()
    assert whole > 1.0  # uneven particles feel it without
    assert np.abs(pressure_forces(flowing, LEVEL)).max() < ROUNDING[precision] * whole
    half = np.abs(pressure_forces(flowing, 0.5 * LEVEL)).max()
    assert half == pytest.approx(0.5 * whole, rel=1e-3)


def test_the_mean_is_that_over_the_neighbours_weighed_by_the_kernel(flowing, precision):
    sim = flowing
    sim.step(1.0)
    p, kernel = sim.particles, sim.model.fluid.kernel
    sim.neighbors.build(p, sim.wall)
    sim._accelerate(sim.model)  # at the positions that can be read
    x = p.in_order(p.position).astype(float)
    q = p.in_order(sim.model.pressure_term).astype(float)
    found = p.in_order(p.mean_pressure_term).astype(float)
    assert q.max() > 0.0
    for i in (0, len(x) // 2, len(x) - 1):
        weight = kernel.w_of(np.linalg.norm(x - x[i], axis=1))
        expected = (weight @ q) / weight.sum()
        assert found[i] == pytest.approx(expected, abs=SUMS[precision] * q.max())


def test_the_next_step_measures_from_it_but_in_buffers_and_beside_them(flowing):
    sim, p = flowing, flowing.particles
    before = np.abs(sim.positions().astype(float)[:, 2])
    sim.step(1.0)
    kept = p.in_order(p.local_datum).astype(float)
    mean = p.in_order(p.mean_pressure_term).astype(float)
    end = 0.5 * LENGTH - sim.neighbors.support_radius
    inside, beside = before < end, before > end + 1e-9
    assert (mean[beside] > 0.0).any()
    assert (kept[beside] == 0.0).all()
    assert mean[inside].max() > 0.0
    np.testing.assert_allclose(kept[inside], LOCAL_SHARE * mean[inside], rtol=1e-6, atol=0.0)
