"""Metrics on states whose answers are known: shifted, escaped, clumped, not finite."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from app.studies.timed_run import (
    RULES,
    Grid,
    TimedRun,
    Trace,
    broken_rule,
    clumped_part,
    errors_of,
    is_at_rest,
)
from taichi_sph.diagnostics import Diagnostics
from taichi_sph.errors import RunError

D = 1e-3
LATTICE = np.stack(np.meshgrid(*[np.arange(10.0)] * 3, indexing="ij"), -1).reshape(-1, 3) * D
FIGURES = Diagnostics(
    time=0.1,
    step=1e-4,
    particles=1000,
    drained={},
    drained_volume=0.0,
    leaks=0,
    wall_corrections=0,
    compression_p99=0.01,
    compression_max=0.02,
    kinetic_energy=1e-5,
    max_speed=0.5,
    fallback_share=0.0,
)


def simulation(positions: np.ndarray = LATTICE) -> SimpleNamespace:
    """As much of a simulation as the metrics look at."""
    return SimpleNamespace(
        positions=lambda: positions,
        velocities=lambda: np.tile([0.0, -0.1, 0.0], (len(positions), 1)),
        derived=SimpleNamespace(expected_speed=1.0),
        particles=SimpleNamespace(mass=1e-6, count={None: 1000}),
        scene=SimpleNamespace(discretization=SimpleNamespace(spacing=D), gravity=(0.0, -9.81, 0.0)),
        vessel=SimpleNamespace(vertices=LATTICE - [0.0, 0.05, 0.0]),
    )


def verdict(positions: np.ndarray = LATTICE, **changes: float) -> str:
    """Which rule a state breaks that is sound but for what is given."""
    return broken_rule(simulation(positions), replace(FIGURES, **changes), 1000, 1.0, 2e-5)  # type: ignore[arg-type]


def test_a_sound_state_breaks_no_rule():
    assert verdict() == ""


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"leaks": 1}, ""),  # one in a thousand is allowed
        ({"leaks": 2}, "0.2 % leaked"),
        ({"compression_p99": 0.12}, "compressed by 12 %"),
        ({"max_speed": 3.5}, "a speed of 3.5 m/s"),
        ({"kinetic_energy": 2.4e-5}, "1.2 times the energy there can be"),
        ({"fallback_share": 0.5}, "guarded for 50 % of the time"),
        ({"kinetic_energy": math.nan}, "not finite"),
        ({"max_speed": math.inf}, "not finite"),
    ],
)
def test_each_rule_is_broken_by_what_it_is_about(changes, says):
    assert verdict(**changes) == says


def test_a_nan_is_dead_and_never_skipped():
    broken = LATTICE.copy()
    broken[7, 1] = np.nan
    assert verdict(broken) == "not finite"


def test_a_clumped_cloud_is_told_from_an_even_one():
    assert clumped_part(LATTICE, D) == 0.0
    pairs = LATTICE.copy()
    pairs[:20] = pairs[20:40] + [0.1 * D, 0.0, 0.0]  # twenty upon twenty others
    assert clumped_part(pairs, D) == pytest.approx(0.04)
    assert verdict(pairs) == "4 % clumped"
    assert clumped_part(LATTICE[:1], D) == 0.0


def test_the_grid_keeps_sums_and_smears_a_shift_in_proportion():
    grid = Grid.over(np.zeros(3), np.full(3, 9 * D), 4 * D)
    values = np.random.default_rng(0).normal(size=LATTICE.shape)
    total = grid.share_out(LATTICE, values)
    np.testing.assert_allclose(total.sum(axis=0), values.sum(axis=0), rtol=1e-12)
    # One particle in the middle of a cell, then shifted by a quarter of it: a quarter goes over.
    here = grid.lower + 2.5 * grid.cell
    unit = np.array([[0.0, -1.0, 0.0]])
    before = grid.share_out(here[None], unit)
    after = grid.share_out(here[None] + [0.25 * grid.cell, 0.0, 0.0], unit)
    assert np.abs(before).max() == pytest.approx(1.0)
    assert np.abs(after - before).sum() == pytest.approx(0.5)


def trace(shift: float = 0.0, escaped: int = 0, frames: int = 5) -> Trace:
    """A lattice that falls by a cell a frame, shifted to the side [m], some of it gone."""
    grid = Grid.over(np.zeros(3) - 0.02, np.full(3, 9 * D) + 0.02, 4 * D)
    found = Trace(0.1)
    for k in range(frames):
        x = LATTICE[escaped:] + [shift, -4 * D * k, 0.0]
        figures = replace(FIGURES, particles=len(x), leaks=escaped, kinetic_energy=k * 1e-6)
        found.note(simulation(x), figures, 1000, grid)  # type: ignore[arg-type]
    return found


def test_a_shifted_cloud_is_as_wrong_as_its_shift():
    errors = errors_of(trace(shift=2 * D), trace())
    assert errors.path == pytest.approx(2 / 16)
    assert errors.drained == errors.energy == 0.0
    # Half a cell of a cloud two and a half cells wide: 2/10 of it has moved over, counted twice.
    assert errors.field == pytest.approx(0.4, rel=0.02)
    same = errors_of(trace(), trace())
    assert (same.path, same.field) == (0.0, 0.0)


def test_one_escaped_particle_counts():
    found = trace(escaped=1)
    assert errors_of(found, trace()).drained == pytest.approx(1e-3)
    assert found.leaked == [1e-3] * 5


def test_a_run_that_diverges_is_dead_from_then_on():
    class Diverging(SimpleNamespace):
        steps = 0

        def advance_to(self, until: float) -> None:
            self.steps += 1
            if until > 0.15:
                raise RunError("the run diverged")

        def diagnostics(self) -> Diagnostics:
            return FIGURES

    made = Diverging(**vars(simulation()))
    pour = TimedRun("x", made, Trace(0.1), rules=RULES)  # type: ignore[arg-type]
    for k in range(1, 5):
        pour.frame(0.1 * k)
    assert pour.failure == "the run diverged"
    assert len(pour.trace.drained) == 1
    assert math.isnan(pour.wall_per_simulated)


@pytest.mark.parametrize(
    ("way", "gravity", "rests"),
    [
        (0.5 * 9.81, 9.81, False),  # it falls, if only for a moment
        (0.02 * 9.81, 9.81, True),
        (0.02 * 9.81, 0.0, True),  # nothing pulls
        (30.0 * 9.81, 9.81, False),
    ],
)
def test_blood_is_at_rest_that_stays_where_it_is_and_is_held_there(way, gravity, rests):
    frames = np.arange(1, 5)
    found = Trace(1e-2, 1e-2, gravity, drained=[0.0] * 4)
    found.centre = [np.array([0.0, 0.0, -way * (1e-2 * k) ** 2]) for k in frames]
    assert is_at_rest(found) == rests
