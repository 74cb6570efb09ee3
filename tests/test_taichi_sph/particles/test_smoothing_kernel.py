import numpy as np
import pytest
import taichi as ti

from builders import KERNEL, R, float_dtype, precision
from reference import wendland, wendland_gradient
from taichi_sph.particles.smoothing_kernel import WendlandC2

INTEGRAL = 1e-12
"""A polynomial is integrated exactly; what is left is the rounding of 20 terms."""
DIFFERENCE = 1e-8
"""A step of 2e-5 R leaves its square times a sixth of the third derivative, 120 W(0)/R^3."""
SAME = {"f64": 1e-13, "f32": 2e-6}
"""A few roundings, of the largest value: the powers of a small 1 - q cancel nothing."""

RADII = np.linspace(0.0, 1.5 * R, 301)


@ti.kernel
def evaluate(
    kernel: ti.template(),
    r: ti.types.ndarray(),
    w: ti.types.ndarray(),
    slope: ti.types.ndarray(),
):
    for k in range(r.shape[0]):
        w[k] = kernel.w(r[k])
        slope[k] = kernel.slope(r[k])


def compiled(kernel: WendlandC2, radii: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    r = radii.astype(float_dtype())
    w, slope = np.zeros_like(r), np.zeros_like(r)
    evaluate(kernel, r, w, slope)
    return w, slope


@pytest.mark.parametrize("support", [6e-5, R, 1.0])
def test_kernel_integrates_to_one(support):
    node, weight = np.polynomial.legendre.leggauss(20)
    r = 0.5 * support * (node + 1.0)
    integral = (0.5 * support * weight * 4.0 * np.pi * r**2 * WendlandC2(support).w_of(r)).sum()
    assert integral == pytest.approx(1.0, abs=INTEGRAL)


def test_kernel_is_the_published_polynomial():
    np.testing.assert_allclose(
        KERNEL.w_of(RADII), wendland(RADII, R), rtol=0, atol=SAME["f64"] * KERNEL.peak
    )


def test_kernel_and_slope_vanish_from_the_support_radius_on():
    outside = np.array([1.0, 1.0 + 1e-12, 1.5, 1e6]) * R
    w, slope = compiled(KERNEL, outside)
    for values in (KERNEL.w_of(outside), KERNEL.slope_of(outside), w, slope):
        # In f32 R * (1/R) may fall an ulp short of one: (1e-7)^3 of the peak is zero enough.
        assert np.all(np.abs(values) <= 1e-20 * np.abs(KERNEL.slope_peak))


def test_slope_times_distance_is_the_central_difference_of_the_kernel():
    r, h = np.linspace(0.01, 0.99, 99) * R, 2e-5 * R
    difference = (KERNEL.w_of(r + h) - KERNEL.w_of(r - h)) / (2 * h)
    error = np.abs(KERNEL.slope_of(r) * r - difference)
    assert error.max() * R / KERNEL.peak < DIFFERENCE


def test_gradient_vector_is_slope_times_separation():
    r_ij = np.random.default_rng(1).uniform(-R, R, (200, 3))
    slope = KERNEL.slope_of(np.linalg.norm(r_ij, axis=1))
    np.testing.assert_allclose(
        slope[:, None] * r_ij, wendland_gradient(r_ij, R), atol=SAME["f64"] * KERNEL.peak / R
    )


def test_kernel_falls_all_the_way_to_the_support_radius():
    inside = np.linspace(0.0, 0.999, 500) * R
    assert np.all(np.diff(KERNEL.w_of(inside)) < 0.0)
    assert np.all(KERNEL.slope_of(inside) < 0.0)


@pytest.mark.parametrize("support", [6e-5, R])
def test_compiled_kernel_equals_the_numpy_one(support):
    kernel, radii = WendlandC2(support), RADII / R * support
    w, slope = compiled(kernel, radii)
    limit = SAME[precision()]
    np.testing.assert_allclose(w, kernel.w_of(radii), rtol=0, atol=limit * kernel.peak)
    np.testing.assert_allclose(
        slope, kernel.slope_of(radii), rtol=0, atol=limit * abs(kernel.slope_peak)
    )
