"""Reservoirs: blood at rest under one pressure, driven by a difference, and Bernoulli's head."""

import math
from dataclasses import replace

import numpy as np
import pytest

from driven_tube import DENSITY, ENDS, LENGTH, OF_ONE, D, area, drive, make_tube
from taichi_sph.boundary.inflow import buffer_layers
from taichi_sph.simulation import Simulation
from taichi_sph.waveform import RAMP_TIME

REST = 0.02
"""Of the jet's speed that the pressure would make, sqrt(2 p/rho): sound still rings."""
RINGING = 0.05
"""Of the pressure: its mean over a few periods of the sound that is left."""
PUSHED = 0.1
"""Of the momentum: in 1 ms the wall takes 1.5 sqrt(nu t)/R, some 7 %."""


@pytest.fixture(scope="module")
def packed(tube: Simulation) -> tuple[list[tuple[float, float, float]], object]:
    """The tube between two reservoirs of 100 Pa: time, speeds, pressure inside; and its state."""
    tube.time = 0.0
    tube.reset()
    drive(tube, "top", pressure=100.0)
    drive(tube, "bottom", pressure=100.0)
    history = []
    for frame in range(1, 76):
        tube.advance_to(0.002 * frame)
        pressure = tube.pressures()[np.abs(tube.positions()[:, 2]) < 0.3 * LENGTH].mean()
        history.append((*(p.speed for p in tube.inflow.openings), pressure))
    return history, tube.save_state()


def test_blood_between_reservoirs_of_one_pressure_comes_to_rest_under_it(driven, packed):
    history, state = packed
    speeds, pressure = np.array(history)[:, :2], np.array(history)[:, 2]
    jet = math.sqrt(2.0 * 100.0 / DENSITY)
    # At no time does it flow or ring: its level is a datum, and it has settled.
    assert np.abs(speeds).max() < 0.1 * jet
    risen = np.minimum(1.0, 0.002 * np.arange(1, 76) / RAMP_TIME)
    assert np.abs(pressure - 100.0 * risen).max() < 30.0
    assert np.abs(speeds[-25:].mean(axis=0)).max() < 0.5 * REST * jet
    assert math.sqrt((speeds[-25:] ** 2).mean()) < REST * jet
    # A plug presses with p on what its strands take up; the blood before it is on all the opening.
    taken = area(driven) / driven.inflow.openings[0].opening.area
    assert 100.0 * (taken - RINGING) < pressure[-25:].mean() < 100.0 * (1.0 + RINGING)
    drive(driven, "top", pressure=100.0)
    drive(driven, "bottom", pressure=100.0)
    driven.load_state(state)
    assert np.linalg.norm(driven.velocities(), axis=1).mean() < REST * jet
    assert driven.diagnostics().leaks == 0


def test_more_pressure_on_one_side_accelerates_the_column_by_dp_over_rho_l(driven, packed):
    # L is the length of all that moves, buffers too, at the buffers' cross-section: the force is
    # dp A, and rho A L is the mass.
    more, time = 50.0, 1e-3
    moved = []
    for extra in (0.0, more):
        drive(driven, "top", pressure=100.0 + extra)
        drive(driven, "bottom", pressure=100.0)
        driven.load_state(packed[1])
        begin = driven.time
        driven.advance_to(begin + time)
        moved.append(driven.velocities().astype(float).sum(axis=0))
        count = driven.particles.count[None]
    # What rings on is the same in both.
    speed = (moved[0] - moved[1]) / count
    length = count * OF_ONE / area(driven)
    assert length == pytest.approx(LENGTH + 2 * buffer_layers(D, 2.0 * D) * D, rel=0.25)
    expected = more / (DENSITY * length) * time
    assert speed[2] == pytest.approx(expected, rel=PUSHED)
    assert np.abs(speed[:2]).max() < 0.02 * expected


@pytest.mark.validation
def test_a_reservoir_spends_head_on_the_speed_of_what_it_gives(tmp_path):
    # A column of length L between two reservoirs of one pressure: L du/dt = -u^2/2 and friction,
    # which is small in blood as thin as this.  Given the whole pressure at both ends it is driven
    # on: after 0.05 s it had 0.41 m/s, and in a bifurcation ever more.
    sim, speed, time = make_tube(tmp_path, 3.5e-3), 0.5, 0.05
    for name in ENDS:
        drive(sim, name, pressure=400.0)
    sim.advance_to(0.1)
    state = sim.save_state()
    velocity = np.zeros_like(state.particles["velocity"])
    velocity[:, 2] = -speed
    rows = state.boundaries["inflow"]["openings"]
    for row, driven in zip(rows, sim.inflow.openings, strict=True):
        row["speed"] = speed * float(driven.opening.normal[2])
    sim.load_state(replace(state, particles={**state.particles, "velocity": velocity}))
    length = sim.particles.count[None] * OF_ONE / area(sim)
    sim.advance_to(state.time + time)
    slowed = speed / (1.0 + 0.5 * speed * time / length)
    top, bottom = (inlet.speed for inlet in sim.inflow.openings)
    assert 0.6 * slowed < 0.5 * (top - bottom) < slowed
    assert sim.diagnostics().leaks == 0
