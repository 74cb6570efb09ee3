"""Suction: what it takes, how fast, and where."""

import math

import pytest

from bleeding_tube import OF_ONE, D, assert_account_is_whole
from taichi_sph.assemble import SKIN
from taichi_sph.boundary.outlets import SUCTION
from taichi_sph.boundary.suction import Suction
from taichi_sph.boundary.tool import Tool


def test_suction_takes_blood_at_its_rate_and_no_more(sim):
    rate, time = 2e-6, 0.03
    sim.suction.set(rate, 4e-3)
    sim.advance_to(time)
    taken = int(sim.outlets.outflow_counts()[SUCTION])
    assert_account_is_whole(sim)
    # A particle is owed until it is whole, and taken when lists are next built: with blood at
    # 1 m/s within 0.1 ms of half their skin.
    late = rate * 0.5 * SKIN * 2.0 * D / 0.02 / OF_ONE
    assert rate * time / OF_ONE - 1.0 - late <= taken <= rate * time / OF_ONE
    assert sim.diagnostics().sucked_volume == pytest.approx(taken * OF_ONE)
    sim.suction.set(0.0)
    sim.advance_to(time + 0.005)
    assert int(sim.outlets.outflow_counts()[SUCTION]) == taken


def test_suction_that_reaches_no_blood_owes_none(sim):
    sim.suction.set(1e-4, 1e-4)
    sim.advance_to(0.004)
    assert int(sim.outlets.outflow_counts()[SUCTION]) == 0
    # What is due since the lists were built, and not since suction was turned on.
    since = sim.suction.save_state()["taken_until"]
    assert since > 0.0035
    sim.suction.set(1e-4, 4e-3)
    sim.advance_to(0.0041)
    most = 1 + math.ceil(1e-4 * (0.0041 - since) / OF_ONE)
    assert int(sim.outlets.outflow_counts()[SUCTION]) <= most


def test_a_mere_tip_has_the_lists_built_only_where_it_sucks(sim):
    tool = Tool(sim.blood, None, sim.tool.position)
    suction, model = Suction(sim.blood, sim.outlets, tool, D), sim.model

    def lists_reach() -> float:
        return tool.before_drift(1e-4, model) + suction.before_drift(1e-4, model)

    tool.move_to(tool.position + [0.0, 0.0, 1e-3])
    assert lists_reach() == 0.0
    suction.set(1e-6)
    tool.move_to(tool.position + [0.0, 0.0, 1e-3])
    assert lists_reach() == pytest.approx(1e-3)
    assert lists_reach() == 0.0
