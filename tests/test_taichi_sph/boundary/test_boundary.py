"""All boundaries together: a state that goes on bit by bit, and a reset that forgets all."""

import numpy as np
import pytest

from bleeding_tube import (
    HOLE,
    LENGTH,
    OF_ONE,
    SIDE,
    D,
    assert_account_is_whole,
    assert_same,
    wall_of,
)
from states import through_a_file
from taichi_sph.boundary.outlets import DROPLET_TIME, SUCTION
from taichi_sph.boundary.wounds import LEAST_RADIUS
from taichi_sph.errors import InputError
from taichi_sph.simulation import Simulation


def state_of(sim: Simulation) -> tuple[list[np.ndarray], dict]:
    """All that is to be the same bit by bit."""
    kept = sim.save_state()
    order = np.argsort(kept.particles["identity"])
    rows = [values[order] for values in kept.particles.values()]
    counted = [kept.boundaries["outlets"].pop("removed"), kept.boundaries["tracer"].pop("age_sum")]
    return [*counted, *rows, *wall_of(sim)], kept.boundaries


def test_a_session_goes_on_bitwise_with_wounds_suction_a_moving_tool_and_a_tilt(sim, tmp_path):
    sim.advance_to(0.02)
    sim.wounds.open(-SIDE, HOLE)
    sim.wounds.open(SIDE, HOLE, np.array([4e-3, 3e-3, 2e-3]))
    sim.suction.set(3e-6, 4e-3)
    sim.gravity = (1.0, 2.0, -9.0)
    sim.inflow.set_factor(0.7)
    sim.tool.move_to(np.array([1e-3, -1e-3, 0.0]), np.array([0.8, 0.0, 0.6, 0.0]))
    sim.advance_to(0.036)
    sim.wounds.close(0)
    sim.advance_to(0.04)
    kept = sim.save_state()
    removed = kept.boundaries["outlets"]["removed"]
    tool = sim.tool
    assert tool.velocity.any()
    assert tool.spin.any()
    sim.advance_to(0.046)
    expected, told = state_of(sim)
    at = tool.position.copy()
    assert int(sim.outlets.outflow_counts()[SUCTION]) > int(removed[SUCTION]) > 0
    assert sim.outlets.outflow_counts()[5] > removed[5] > 0
    # Another life between.
    sim.reset()
    sim.wounds.open(SIDE, LEAST_RADIUS * D)
    sim.tool.move_to(np.array([0.0, 2e-3, 0.0]))
    sim.advance_to(sim.time + 0.002)
    sim.load_state(through_a_file(kept, tmp_path))
    assert sim.time == 0.04
    assert [w.is_open for w in sim.wounds] == [False, True]
    sim.advance_to(0.046)
    found, tells = state_of(sim)
    assert_same(found, expected)
    assert tells == told
    assert sim.tool.position.tobytes() == at.tobytes()


def test_a_session_goes_on_bitwise_from_the_step_in_which_the_tool_arrives(sim):
    tool = sim.tool
    sim.tool.move_to(tool.position + [2e-7, 0.0, 0.0])
    sim.step(1.0)
    while np.linalg.norm(tool.target_position - tool.position) >= 1e-7:
        sim.step(1.0)
    assert tool.velocity.any()
    kept = sim.save_state()

    def some_steps() -> list[np.ndarray]:
        for _ in range(5):
            sim.step(1.0)
        return state_of(sim)[0]

    expected = some_steps()
    sim.reset()
    sim.load_state(kept)
    assert_same(some_steps(), expected)


def test_a_reset_gives_back_blood_wall_tool_inflow_and_counts(sim):
    wall, x = wall_of(sim), sim.positions()
    sim.wounds.open(SIDE, HOLE)
    sim.suction.set(1e-5, 4e-3)
    sim.gravity = (0.0, 9.81, 0.0)
    sim.inflow.set_factor(2.0)
    sim.tool.move_to(np.array([0.0, 0.0, 2e-3]))
    sim.advance_to(0.02)
    assert sim.outlets.outflow_counts().sum() > 0
    steps = sim.steps
    sim.reset()
    assert_same(wall_of(sim), wall)
    assert sim.positions().tobytes() == x.tobytes()
    assert not sim.velocities().any()
    assert sim.identities().tolist() == list(range(len(x)))
    assert sim.outlets.outflow_counts().tolist() == [0] * len(sim.outlets.outflow_counts())
    assert sim.gravity == (0.0, 0.0, -9.81)
    assert (len(sim.wounds), sim.suction.rate, sim.inflow.added) == (0, 0.0, 0)
    assert sim.tool.position.tolist() == [0.0, 0.0, -5e-3]
    assert sim.tool.at_rest
    (inlet,) = sim.inflow.openings
    assert (inlet.factor, inlet.speed, inlet.displacement, inlet.volume_in) == (0, 0, 0, 0)
    assert inlet.target_factor == 1.0
    # The clock goes on.
    assert (sim.time, sim.steps) == (0.02, steps)
    sim.advance_to(0.03)
    assert_account_is_whole(sim)
    assert sim.outlets.outflow_counts()[[SUCTION, 4]].tolist() == [0, 0]


def test_after_a_reset_no_drops_of_before_fall(sim):
    sim.advance_to(0.04)
    sim.wounds.open(SIDE, HOLE)
    sim.advance_to(0.06)
    assert len(sim.outlets.droplets()) > 0
    assert sim.time < DROPLET_TIME
    sim.reset()
    assert len(sim.outlets.droplets()) == 0


def test_the_force_on_a_tool_is_a_mean_since_it_was_last_asked(sim):
    sim.tool.take_force()
    sim.advance_to(0.002)
    impulse, time = sim.tool._impulse.copy(), sim.tool._impulse_time
    assert time == pytest.approx(0.002)
    np.testing.assert_allclose(sim.tool.take_force(), impulse / time)
    assert sim.tool.take_force().tolist() == [0.0, 0.0, 0.0]


def test_no_blood_begins_in_the_tool(sim):
    x = sim.positions()
    away = np.linalg.norm(x - [0.0, 0.0, -5e-3], axis=1)
    # Settled blood keeps half a spacing from a plane, less from a ball of 1.7 spacings.
    assert away.min() > 2e-3 + 0.2 * D
    # And the rest is full, but for what curved walls leave no room for.
    room = sim.vessel.volume - 4.0 / 3.0 * np.pi * 2e-3**3
    inside = np.abs(x[:, 2]) < 0.5 * LENGTH
    assert 0.95 * room < inside.sum() * OF_ONE < 1.01 * room


def test_a_state_that_is_refused_changes_nothing(sim):
    sim.advance_to(0.002)
    before, _ = state_of(sim)
    other = sim.save_state()
    other.particles["position"][:] += 1e-3
    other.boundaries["inflow"]["openings"].pop()
    with pytest.raises(InputError, match="a state of 0 driven openings: the scene has 1"):
        sim.load_state(other)
    assert sim.time == 0.002
    assert_same(state_of(sim)[0], before)
