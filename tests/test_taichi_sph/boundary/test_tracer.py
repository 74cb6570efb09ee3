"""Dye and age: which blood is marked, that a mark stays with its particle, what is refused."""

import numpy as np
import pytest

from driven_tube import FLOW, LENGTH, OF_ONE, D
from taichi_sph.boundary.tracer import Tracer
from taichi_sph.errors import InputError
from taichi_sph.simulation import Simulation


def tracer_of(sim: Simulation) -> Tracer:
    return sim.boundary(Tracer)


def dye_of(sim: Simulation) -> dict[int, float]:
    """Concentration by identity."""
    rows = sim.particles.rows()
    return dict(zip(rows["identity"].tolist(), rows["dye"].tolist(), strict=True))


def test_a_ball_of_blood_is_marked_and_each_particle_keeps_its_mark(driven):
    driven.advance_to(0.01)
    rows, centre, radius = driven.particles.rows(), np.array([1e-3, 0.0, -1e-3]), 2.0 * D
    inside = np.linalg.norm(rows["position"] - centre, axis=1) < radius
    assert tracer_of(driven).mark_ball(centre, radius, 0.75) == inside.sum() > 10
    expected = {int(i): 0.75 * float(m) for i, m in zip(rows["identity"], inside, strict=True)}
    assert dye_of(driven) == expected
    # Rows are sorted anew meanwhile, blood is added and leaves.
    driven.advance_to(0.06)
    assert driven.inflow.added > 0
    assert dye_of(driven) == {i: expected.get(i, 0.0) for i in dye_of(driven)}


def test_what_comes_in_is_marked_from_now_on_and_as_much_as_comes_in(driven):
    driven.advance_to(0.08)
    rows = driven.particles.rows()
    inside = set(rows["identity"][rows["position"][:, 2] < 0.5 * LENGTH].tolist())
    pump = next(p for p in driven.inflow.openings if p.opening.name == "top")
    before = pump.volume_in
    tracer_of(driven).mark_inflow("top")
    driven.advance_to(0.12)
    dye, rows = dye_of(driven), driven.particles.rows()
    assert not any(dye[i] for i in inside & dye.keys()), "what was in the vessel is as it was"
    there = rows["identity"][np.abs(rows["position"][:, 2]) < 0.5 * LENGTH]
    crossed = set(there.tolist()) - inside
    assert all(dye[i] == 1.0 for i in crossed)
    # The strands cross one after the other: within a layer of them.
    strands = len(pump.sites)
    assert len(crossed) == pytest.approx((pump.volume_in - before) / OF_ONE, abs=strands)
    assert len(crossed) > 2 * strands


def test_clear_blood_may_follow_dye(driven):
    tracer_of(driven).mark_inflow("top")
    driven.advance_to(0.06)
    tracer_of(driven).mark_inflow("top", 0.0)
    first_clear = driven.inflow.next_identity
    driven.advance_to(0.1)
    dye = dye_of(driven)
    assert all(dye[i] == 0.0 for i in dye if i >= first_clear)
    assert any(dye[i] == 1.0 for i in dye)


def test_a_state_keeps_dye_and_where_it_comes_in_and_a_reset_clears_both(driven):
    driven.advance_to(0.01)
    tracer_of(driven).mark_inflow("top", 0.5)
    tracer_of(driven).mark_ball(np.zeros(3), 2.0 * D)
    state = driven.save_state()
    driven.advance_to(0.05)
    first = driven.save_state().particles
    driven.reset()
    assert not any(dye_of(driven).values())
    driven.advance_to(driven.time + 0.02)
    assert not any(dye_of(driven).values()), "nothing comes in marked"
    driven.load_state(state)
    driven.advance_to(0.05)
    again = driven.save_state().particles
    assert again["dye"].any() and again["dye"].tobytes() == first["dye"].tobytes()


@pytest.mark.parametrize(
    ("ask", "says"),
    [
        (lambda t: t.mark_inflow("side"), "'side'; driven: top, bottom"),
        (lambda t: t.mark_ball(np.array([1.0, 0.0, 0.0]), 1e-3), "no blood is within 0.001 m"),
        (lambda t: t.mark_ball(np.zeros(3), 1e-2, 1.5), "concentration of 1.5; allowed: 0 to 1"),
        (lambda t: t.mark_inflow("top", float("nan")), "concentration of nan; allowed: 0 to 1"),
    ],
)
def test_what_cannot_be_marked_is_refused_and_nothing_changes(driven, ask, says):
    with pytest.raises(InputError, match="dye: ") as refused:
        ask(tracer_of(driven))
    assert says in str(refused.value)
    assert not any(dye_of(driven).values()) and not tracer_of(driven).in_use


def test_blood_is_as_old_as_it_has_been_in_the_vessel(driven):
    rows = driven.particles.rows()
    # Farther from both ends than blood flows within the time, at twice the mean speed.
    inside = rows["identity"][np.abs(rows["position"][:, 2]) < 2.5e-3]
    age = {}
    for time in (0.02, 0.03):
        driven.advance_to(time)
        rows = driven.save_state().particles
        age = dict(zip(rows["identity"].tolist(), rows["age"].tolist(), strict=True))
        # Behind by the steps since the lists were built.
        assert all(time - 2e-3 < age[i] <= time * (1.0 + 1e-5) for i in inside.tolist())
    added = [i for i in age if i >= driven.inflow.next_identity - driven.inflow.added]
    beyond = rows["identity"][rows["position"][:, 2] > 0.5 * LENGTH]
    assert added and not any(age[i] for i in {*added, *beyond.tolist()}), "not yet come in"


@pytest.mark.validation
def test_the_mean_age_of_what_leaves_a_steady_flow_is_its_volume_over_the_flow(driven):
    # Danckwerts 1953.  The tube is emptied three times before, and twice meanwhile: the first blood
    # that comes in is 2 % older, for the flow is not steady yet.
    places = len(driven.vessel.openings) + 2
    bottom = 2 + [o.name for o in driven.vessel.openings].index("bottom")

    def left() -> tuple[float, int]:
        count = driven.outlets.outflow_counts()
        mean = tracer_of(driven).mean_age()
        assert mean.shape == count.shape >= (places,)
        assert np.isnan(mean[count == 0]).all()
        assert driven.diagnostics().mean_age["bottom"] == mean[bottom]
        return float(mean[bottom] * count[bottom]), int(count[bottom])

    driven.advance_to(0.18)
    sum_before, count_before = left()
    volumes = []
    for time in np.linspace(0.19, 0.3, 12):
        driven.advance_to(time)
        z = driven.positions()[:, 2]
        volumes.append((np.abs(z) < 0.5 * LENGTH).sum() * OF_ONE)
    sum_after, count_after = left()
    assert count_after - count_before > 1000
    mean = (sum_after - sum_before) / (count_after - count_before)
    # Ages are behind by the steps between two lists, on the way in and on the way out.
    assert mean == pytest.approx(np.mean(volumes) / FLOW, rel=0.02)


def test_a_state_keeps_ages_and_those_of_what_has_left_and_a_reset_begins_anew(driven):
    driven.advance_to(0.08)
    state = driven.save_state()
    driven.advance_to(0.11)
    first, mean = driven.save_state().particles["age"], tracer_of(driven).mean_age()
    driven.reset()
    assert not driven.particles.rows()["age"].any()
    assert np.isnan(tracer_of(driven).mean_age()).all()
    start = driven.time
    driven.advance_to(start + 0.01)
    assert driven.particles.rows()["age"].max() <= 0.01 * (1.0 + 1e-5)
    driven.load_state(state)
    driven.advance_to(0.11)
    assert driven.save_state().particles["age"].tobytes() == first.tobytes()
    np.testing.assert_array_equal(tracer_of(driven).mean_age(), mean)


def test_a_state_from_before_there_was_age_is_gone_on_with(driven):
    driven.advance_to(0.08)
    state = driven.save_state()
    for key in ("aged_until", "age_sum"):
        del state.boundaries["tracer"][key]
    del state.particles["age"]
    driven.advance_to(0.1)
    driven.load_state(state)
    driven.advance_to(0.085)
    assert 0.0 < driven.particles.rows()["age"].max() <= 0.005 * (1.0 + 1e-5)
