"""The datum of pressure: only differences move blood in a closed vessel, and figures are whole."""

import math

import msgspec
import numpy as np
import pytest

from driven_tube import DENSITY, ENDS, LENGTH, drive
from taichi_sph.boundary.datum import (
    CHANGE_TIME,
    FALL_TIME,
    LEAST_PRESSURE,
    RISE_TIME,
    PressureDatum,
)
from taichi_sph.boundary.wounds import Wound
from taichi_sph.derived import is_closed
from taichi_sph.fluid.local_datum import LOCAL_SHARE
from taichi_sph.simulation import Simulation

STEPS = 25
SAME = {"f64": 1e-6, "f32": 2e-3}
"""Of the largest speed: buffers sum accelerations as multiples of 1e-6 m/s^2."""


def states(sim: Simulation, top: float, bottom: float, gravity=(0.0, 0.0, 0.0)):
    """Speeds of the blood between two reservoirs [m/s], once their pressures are there."""
    sim.time = 0.0
    sim.reset()
    sim.gravity = gravity
    drive(sim, "top", pressure=top)
    drive(sim, "bottom", pressure=bottom)
    for opening in sim.inflow.openings:
        opening.factor = 1.0
    for _ in range(STEPS):
        sim.step(1.0)
    return sim.velocities().astype(float)


def test_a_pressure_that_all_reservoirs_share_moves_no_blood(driven, precision):
    moved = states(driven, 50.0, 20.0)
    sound = driven.blood.sound_speed
    lifted = states(driven, 12450.0, 12420.0)
    assert driven.blood.sound_speed == pytest.approx(sound, rel=1e-9)
    assert np.abs(moved).max() > 1e-3
    np.testing.assert_allclose(lifted, moved, rtol=0, atol=SAME[precision] * np.abs(moved).max())


def test_gravity_that_reservoirs_balance_moves_no_blood(driven, precision):
    g = (3.0, -4.0, -8.0)
    moved = states(driven, 50.0, 20.0)
    heads = [DENSITY * float(np.dot(g, ENDS[name])) for name in ("top", "bottom")]
    balanced = states(driven, 50.0 + heads[0], 20.0 + heads[1], g)
    np.testing.assert_allclose(balanced, moved, rtol=0, atol=SAME[precision] * np.abs(moved).max())
    assert driven.blood.felt_gravity == (0.0, 0.0, 0.0)


def test_figures_report_the_whole_pressure(driven):
    g = (0.0, 0.0, -9.81)
    states(driven, 12400.0, 12400.0 + DENSITY * 9.81 * LENGTH, g)
    x = driven.positions().astype(float)
    inside = np.abs(x[:, 2]) < 0.3 * LENGTH
    # Hydrostatics, from the plane of the top; less the least p', which sound still carries about.
    expected = 12400.0 + DENSITY * 9.81 * (ENDS["top"][2] - x[inside, 2])
    found = driven.pressures()[inside]
    level = DENSITY * (driven.blood.sound_speed / 10.0) ** 2
    assert abs((found - expected).mean()) < level
    slope = np.polyfit(x[inside, 2], found - driven.pressures()[inside].mean(), 1)[0]
    assert slope == pytest.approx(-DENSITY * 9.81, abs=level / LENGTH)


def test_the_lowest_reservoir_is_a_little_above_the_datum(driven):
    states(driven, 12450.0, 12420.0, (0.0, -9.81, 0.0))
    datum, scale = driven.blood.datum, driven.blood.sound_speed / 10.0
    least = min(
        p - float(datum.at(np.array(ENDS[name])))
        for name, p in (("top", 12450.0), ("bottom", 12420.0))
    )
    assert least == pytest.approx(LEAST_PRESSURE * DENSITY * scale**2, rel=0.05)


def test_sound_follows_blood_and_is_no_slower_than_the_drive_asks_for(driven):
    quiet, fast, dt = 0.5, 1.2, 1e-4
    hole = Wound(np.zeros(3), np.zeros(3), np.array([0.0, 0.0, 1.0]), 1e-3, is_open=False)
    datum = PressureDatum(
        driven.blood, driven.inflow.openings, [hole], DENSITY, 48.0, 10.0, quiet
    )  # fmt: skip
    blood = driven.blood
    assert blood.sound_speed == pytest.approx(10.0 * quiet)

    def after(time: float) -> float:
        for _ in range(round(time / dt)):
            datum.before_drift(dt, driven.model)
        return blood.sound_speed

    blood.largest_speed = fast
    assert after(0.5 * RISE_TIME) == pytest.approx(10.0 * quiet * math.exp(0.5), rel=1e-6)
    assert after(2.0 * RISE_TIME) == pytest.approx(10.0 * fast)
    blood.largest_speed = 0.1
    assert after(0.5 * FALL_TIME) == pytest.approx(10.0 * fast * math.exp(-0.5), rel=1e-6)
    assert after(2.0 * FALL_TIME) == pytest.approx(10.0 * quiet)
    hole.is_open = True
    assert after(0.5 * CHANGE_TIME) > 10.0 * fast
    assert blood.datum.share == pytest.approx(0.5)
    assert after(2.0 * CHANGE_TIME) == pytest.approx(48.0)
    assert blood.datum.share == 0.0 and blood.datum.value == 0.0


def test_a_wound_feels_the_whole_pressure_until_it_is_closed(sim):
    assert is_closed(sim.scene)
    sim.advance_to(0.002)
    assert sim.blood.datum.share == 1.0
    vertex = sim.vessel.vertices[np.abs(sim.vessel.vertices[:, 2]).argmin()]
    sim.wounds.open(vertex, 2.0 * sim.scene.discretization.spacing)
    sim.advance_to(0.002 + 2.5 * CHANGE_TIME)
    assert sim.blood.datum.share == 0.0
    assert sim.blood.datum.value == 0.0
    assert sim.blood.felt_gravity == sim.gravity
    assert sim.blood.local_share == 0.0
    assert sim.blood.sound_speed == pytest.approx(sim.derived.sound_speed, rel=0.02)
    assert sim.diagnostics().bled_volume > 0.0
    sim.wounds.close()
    sim.advance_to(0.002 + 3.7 * CHANGE_TIME)
    assert sim.blood.datum.share == 1.0
    assert sim.blood.local_share == LOCAL_SHARE


def test_a_vessel_with_an_open_end_has_no_datum(driven):
    change = msgspec.structs.replace
    scene = driven.scene
    assert is_closed(scene)
    column = change(scene.column, full=False, height=0.01)
    assert not is_closed(change(scene, column=column))
    opened = change(scene.openings["bottom"], pressure=None)
    assert not is_closed(change(scene, openings={**scene.openings, "bottom": opened}))
