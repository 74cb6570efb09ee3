import math

import numpy as np
import pytest

from app.bench import realtime
from app.scenes.library import find_scene, weights_for
from nn.weights import Weights
from taichi_sph.derived import expected_speed
from taichi_sph.geometry.vessel import read_vessel


@pytest.mark.parametrize(("cost", "length"), [(4e-7, 1.0), (4e-7, 3.0), (2e-6, 2.0)])
def test_the_size_in_real_time_is_where_two_power_laws_meet(cost, length):
    sizes = [1000, 2000, 4000, 8000, 16000]
    n = np.array(sizes)
    # A step costs a n and may be b/n^(1/3) long.
    found = realtime.largest_in_real_time(sizes, cost * n, length * 1e-2 * n ** (-1 / 3))
    assert found == pytest.approx((length * 1e-2 / cost) ** 0.75, rel=1e-9)


def test_sizes_beyond_those_measured_are_not_made_up():
    sizes, n = [1000, 2000], np.array([1000, 2000])
    assert realtime.largest_in_real_time(sizes, 1e-3 * n, np.full(2, 4.0)) == math.inf
    assert realtime.largest_in_real_time(sizes, 1e-3 * n, np.full(2, 0.5)) == 0.0


def test_steps_are_as_long_as_the_speed_lets_them():
    scene = find_scene("A")
    weights = Weights.load(weights_for(scene))
    whole = scene.discretization.spacing
    scene = realtime.divided(scene, 4000)
    assert scene.column.particles == 4000
    assert scene.discretization.spacing == pytest.approx(whole * 4 ** (1 / 3), rel=1e-9)
    vessel = read_vessel(scene)
    own = expected_speed(scene, vessel)
    radius = 2.0 * scene.discretization.spacing
    for speed in (0.5, own):
        physics, pcnet = realtime.steps(scene, vessel, weights, speed)
        # C h_s/(c + v) with c = 10 v, and the trained C R/c
        assert physics == pytest.approx(0.4 * 0.5 * radius / (11.0 * speed), rel=1e-6)
        courant = weights.training.courant_number
        assert pcnet == pytest.approx(courant * radius / (10.0 * speed), rel=1e-6)
