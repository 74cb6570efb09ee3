import math

import numpy as np
import pytest
import taichi as ti

from builders import float_dtype, precision
from reference import casson
from taichi_sph.fluid.rheology import Casson, Newtonian, make_rheology
from taichi_sph.scene import CassonTable, NewtonianTable

ETA, TAU_Y, N = 3.5e-3, 5e-3, 7.0
BLOOD = Casson(ETA, TAU_Y, N)
RATES = np.logspace(-5, 5, 401)

SAME = {"f64": 1e-7, "f32": 1e-5}
"""Three terms of the exponential's series leave 1e-2^3/24 of the rise; where the series ends,
1 - exp(-0.01) in f32 keeps five digits."""
REST = 1e-5
"""Rest is evaluated at 1e-12 1/s, where sqrt(n g)/2 of the rise is still missing."""
HIGH_SHEAR = {"f64": 1e-12, "f32": 2e-6}
"""exp(-sqrt(7e5)) is nothing: what is left is rounding."""
SEVEN_DIGITS = 2e-7
"""The published values are printed with seven to eight digits."""


@ti.kernel
def evaluate(law: ti.template(), rate: ti.types.ndarray(), viscosity: ti.types.ndarray()):
    for k in range(rate.shape[0]):
        viscosity[k] = law.viscosity(rate[k])


def viscosities(law: Newtonian | Casson, rates) -> np.ndarray:
    g = np.asarray(rates, dtype=float).astype(float_dtype())
    viscosity = np.zeros_like(g)
    evaluate(law, g, viscosity)
    return viscosity


def test_casson_is_equation_8_with_the_square_root():
    np.testing.assert_allclose(
        viscosities(BLOOD, RATES), casson(RATES, ETA, TAU_Y, N), rtol=SAME[precision()]
    )


def test_casson_at_rest_is_the_closed_form_of_the_plateau():
    plateau = (math.sqrt(ETA) + math.sqrt(N * TAU_Y)) ** 2
    assert plateau == pytest.approx(60.6e-3, rel=1e-3)
    assert viscosities(BLOOD, [0.0])[0] == pytest.approx(plateau, rel=REST)
    assert BLOOD.largest_viscosity == pytest.approx(plateau, rel=1e-14)


def test_casson_at_high_shear_is_the_exact_casson_law():
    rates = np.array([1e5, 1e6])
    exact = (math.sqrt(ETA) + np.sqrt(TAU_Y / rates)) ** 2
    np.testing.assert_allclose(viscosities(BLOOD, rates), exact, rtol=HIGH_SHEAR[precision()])


def test_casson_with_a_fast_regulariser_gives_the_values_of_hemelb():
    law = Casson(0.055**2, 0.1937**2, 1e6)
    published = [6.185169e-2, 5.5308969e-3, 3.241822e-3]
    limit = SEVEN_DIGITS + SAME["f32"] * (precision() == "f32")
    np.testing.assert_allclose(viscosities(law, [1.0, 100.0, 1e4]), published, rtol=limit)


def test_casson_thins_as_it_is_sheared():
    coarse = viscosities(BLOOD, np.logspace(-5, 5, 101))
    assert np.all(np.diff(coarse) < 0.0)


def test_casson_never_exceeds_its_largest_viscosity():
    for law in (BLOOD, Casson(ETA, TAU_Y, N, as_printed=True)):
        assert viscosities(law, [0.0, *RATES]).max() <= law.largest_viscosity * (1 + 1e-6)


def test_casson_without_a_yield_stress_is_newtonian():
    rates = [0.0, *RATES]
    np.testing.assert_allclose(
        viscosities(Casson(ETA, 0.0, N), rates),
        viscosities(Newtonian(ETA), rates),
        rtol=HIGH_SHEAR[precision()],
    )


def test_newtonian_viscosity_does_not_depend_on_the_shear_rate():
    assert np.all(viscosities(Newtonian(ETA), [0.0, *RATES]) == np.asarray(ETA, float_dtype()))


def test_printed_form_is_thin_at_rest_and_thickest_at_a_low_shear_rate():
    printed = Casson(ETA, TAU_Y, N, as_printed=True)
    at_rest, at_peak = viscosities(printed, [0.0, 0.179])
    # sqrt(tau_y g) n at the smallest rate that is evaluated, 1e-6 1/s, doubled by the square.
    assert at_rest == pytest.approx(ETA, rel=2e-2)
    assert at_peak == pytest.approx(31.9e-3, rel=1e-3)
    assert at_peak == pytest.approx(viscosities(printed, RATES).max(), rel=1e-3)


@pytest.mark.parametrize("printed", [False, True])
@pytest.mark.parametrize("n", [1e-3, 7.0, 1e3, 1e6])
def test_viscosity_is_a_number_at_rest_and_at_any_rate(n, printed):
    rates = [0.0, 1e-30, 1e-12, 1e-6, 1.0, 1e12]
    assert np.isfinite(viscosities(Casson(ETA, TAU_Y, n, printed), rates)).all()


def test_scene_tables_become_the_laws_they_name():
    assert make_rheology(NewtonianTable(viscosity=4e-3)) == Newtonian(4e-3)
    table = CassonTable(viscosity=3e-3, yield_stress=6e-3, regularisation=9.0, printed=True)
    assert make_rheology(table) == Casson(3e-3, 6e-3, 9.0, as_printed=True)
