"""Coarse flows against theory, seconds each; the fine ones are in tests/validation."""

import math

import numpy as np
import pytest

from app.validation import analytic, flows
from app.validation.flows import DENSITY, Liquid, state_of
from taichi_sph.fluid.rheology import Newtonian

MU = 3.5e-3
NU = MU / DENSITY
D = 1e-4


@pytest.fixture(scope="module")
def wave() -> tuple[float, float, np.ndarray, np.ndarray]:
    """Decay rate expected, amplitude left after one decay time, and velocities before and after."""
    count = 16
    k = 2.0 * math.pi / (count * D)
    rate = analytic.shear_wave_rate(k, MU, DENSITY)
    speed = 0.02 * D * rate

    def velocity(x):
        return np.column_stack([speed * np.sin(k * x[:, 2]), 0.0 * x[:, 0], 0.0 * x[:, 0]])

    liquid = Liquid(Newtonian(MU), 20.0 * NU / D, D)
    motion = flows.box(liquid, (flows.SLAB, flows.SLAB, count), velocity)
    before = state_of(motion)
    motion.advance_to(1.0 / rate)
    after = state_of(motion)
    left = 2.0 * (after.velocity[:, 0] * np.sin(k * after.position[:, 2])).mean() / speed
    return rate, left, before.velocity, after.velocity


def test_a_shear_wave_of_sixteen_spacings_decays_at_its_viscosity(wave):
    _, left, _, _ = wave
    # The sum over a lattice answers a wave of 16 d some 2 % less than a long one.
    assert -math.log(left) == pytest.approx(1.0, rel=0.04)


def test_a_decaying_wave_keeps_its_momentum(wave, rtol):
    _, _, before, after = wave
    assert np.abs((after - before).sum(axis=0)).max() < rtol * np.abs(before).sum()


@pytest.fixture(scope="module")
def channel_flow() -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Start-up between plates eight spacings apart: time, heights and speeds."""
    across = 8
    width = across * D
    speed = 3.0 * NU / width
    drive = 8.0 * MU * speed / width**2
    liquid = Liquid(Newtonian(MU), 10.0 * speed, D, background_pressure=0.5 * DENSITY * speed**2)
    motion = flows.channel(liquid, across, drive)
    result = []
    for fraction in (0.05, 0.4):
        time = fraction * width**2 / NU
        motion.advance_to(time)
        state = state_of(motion)
        exact = analytic.channel_start_up(state.position[:, 2], time, width, drive, MU, DENSITY)
        result.append((time, state.velocity[:, 0], exact))
    return result


@pytest.mark.validation
def test_a_channel_eight_spacings_wide_starts_up_as_theory_says(channel_flow):
    for _, speed, exact in channel_flow:
        assert np.linalg.norm(speed - exact) < 0.08 * np.linalg.norm(exact)


def test_a_channel_eight_spacings_wide_carries_the_right_flow_rate(channel_flow):
    _, speed, exact = channel_flow[-1]
    assert speed.mean() == pytest.approx(exact.mean(), rel=0.05)


def test_rings_fill_a_tube_and_keep_off_its_wall():
    radius, length = 10 * D, 8 * D
    x = flows.rings(radius, D, length)
    r = np.hypot(x[:, 0], x[:, 1])
    assert r.max() <= radius - 0.5 * D * (1.0 - 1e-9)
    assert len(x) == pytest.approx(math.pi * radius**2 * length / D**3, rel=0.01)


def test_a_scattered_fill_has_the_count_asked_for_inside_the_tube():
    radius, length = 10 * D, 8 * D
    x = flows.scattered(radius, D, length, 2513)
    assert len(x) == 2513
    assert np.hypot(x[:, 0], x[:, 1]).max() <= radius - 0.5 * D * (1.0 - 1e-9)
    assert x[:, 2].min() >= 0.0
    assert x[:, 2].max() <= length


def test_every_proxy_of_a_plane_has_the_same_neighbourhood():
    x = flows.plane_proxies(8 * D, 16 * D, D)
    assert len(x) == 9 * 18
    assert np.unique(np.diff(np.unique(x[:, 0].round(12))).round(10)).size == 1
    assert x[:, :2].max(axis=0) == pytest.approx([8 * D - 4 * D / 9, 16 * D - 4 * D / 9])
