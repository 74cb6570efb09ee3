import numpy as np
import pytest
import taichi as ti

from builders import DENSITY, float_dtype, precision
from taichi_sph.fluid.equation_of_state import Tait

C = 3.0
STATES = [Tait(DENSITY, C), Tait(DENSITY, C, 500.0)]

SAME = {"f64": 1e-13, "f32": 2e-6}
"""Rounding of (rho/rho_0)^7, of rho_0 c^2."""
STEP = {"f64": 1e-4, "f32": 1e-2}
"""Relative step of the difference: the best between its square and the rounding."""
SLOPE = {"f64": 1e-7, "f32": 1e-3}
"""Five times the step squared: the third derivative of a seventh power over six."""


@ti.kernel
def evaluate(state: ti.template(), density: ti.types.ndarray(), pressure: ti.types.ndarray()):
    for k in range(density.shape[0]):
        pressure[k] = state.pressure(density[k], ti.static(state.sound_speed))


def pressures(state: Tait, densities) -> np.ndarray:
    rho = np.asarray(densities, dtype=float).astype(float_dtype())
    p = np.zeros_like(rho)
    evaluate(state, rho, p)
    return p.astype(float)


@pytest.mark.parametrize("state", STATES)
def test_pressure_at_rest_density_is_the_background(state):
    limit = SAME[precision()] * DENSITY * C**2
    assert pressures(state, [DENSITY])[0] == pytest.approx(state.background_pressure, abs=limit)


def test_pressure_rises_with_density_by_the_square_of_the_sound_speed():
    h = STEP[precision()] * DENSITY
    low, high = pressures(STATES[1], [DENSITY - h, DENSITY + h])
    assert (high - low) / (2 * h) == pytest.approx(C**2, rel=SLOPE[precision()])


@pytest.mark.parametrize("state", STATES)
def test_pressure_is_equation_14_where_that_is_positive_and_else_zero(state):
    rho = DENSITY * np.linspace(0.0, 1.5, 61)
    printed = DENSITY * C**2 / 7 * ((rho / DENSITY) ** 7 - 1) + state.background_pressure
    limit = 20 * SAME[precision()] * DENSITY * C**2
    np.testing.assert_allclose(pressures(state, rho), np.maximum(0.0, printed), atol=limit, rtol=0)
    assert printed.min() < 0.0


@pytest.mark.parametrize("state", STATES)
def test_pressure_is_never_below_zero(state):
    assert pressures(state, DENSITY * np.linspace(0.0, 1.0, 201)).min() >= 0.0
    assert pressures(state, [0.5 * DENSITY])[0] == 0.0


@pytest.mark.parametrize("state", STATES)
def test_the_law_in_numpy_is_the_law_in_the_kernels(state):
    rho = DENSITY * np.linspace(0.5, 1.5, 61)
    limit = 20 * SAME[precision()] * DENSITY * C**2
    np.testing.assert_allclose(pressures(state, rho), state.pressure_of(rho), atol=limit, rtol=0)
    assert state.pressure_of(rho).max() > DENSITY * C**2
