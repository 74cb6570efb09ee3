import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from builders import (
    SKIN,
    D,
    Prescribed,
    R,
    cubic_lattice,
    make_fluid,
    make_model,
    periodic,
    plane,
)
from reference import separations
from taichi_sph.boundary.boundary import Boundary
from taichi_sph.errors import InputError, RunError
from taichi_sph.fluid.rheology import Casson, Newtonian
from taichi_sph.simulation import Simulation

GRAVITY = (0.0, 0.0, -9.81)
SOUND = 1.5
BLOOD = make_fluid(SOUND, rheology=Casson(3.5e-3, 5e-3, 7.0), alpha=0.05)
# As good as inviscid: a viscosity of zero allows no viscous limit of the step.
# Shifting takes the energy of random motion, which has no order to keep.
INVISCID = replace(make_fluid(SOUND, background=1000.0, rheology=Newtonian(1e-12)), shifting=0.0)

GROWTH = 1.02
"""Energy of a symplectic run about its start: symplectic Euler lets it swing, not grow."""
WEIGHT = 0.1
"""Twenty samples of a pool whose sound still rings."""


def pool(seed: int = 0, speed: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Six layers on the plane wall, stirred."""
    x = cubic_lattice(8, 8, 6)
    return x, speed * np.random.default_rng(seed).normal(size=x.shape)


def stirred(seed: int = 0, rows: np.ndarray | None = None, **options) -> Simulation:
    x, v = pool(seed)
    rows = np.arange(len(x)) if rows is None else rows
    stage = plane()
    stage.put(x[rows], v[rows], rows)
    return stage.simulation(make_model(BLOOD), GRAVITY, SOUND, **options)


def state(sim: Simulation) -> list[np.ndarray]:
    p = sim.particles
    return [p.in_order(f) for f in (p.position, p.velocity, p.acceleration, p.density)]


def test_two_runs_agree_bitwise():
    runs, steps, builds = [], [], []
    for _ in range(2):
        sim = stirred()
        sim.advance_to(0.02)
        runs.append(state(sim))
        steps.append(sim.steps)
        builds.append(sim.neighbors.builds)
    # More than one list was used, or sorting was not put to the test.
    assert builds[1] - builds[0] > 3
    assert steps[0] == steps[1] > 50
    for first, again in zip(*runs, strict=True):
        np.testing.assert_array_equal(first, again)


def test_a_run_does_not_depend_on_the_rows_that_particles_began_in():
    first = stirred()
    first.advance_to(0.01)
    expected = state(first)
    shuffled = stirred(rows=np.random.default_rng(1).permutation(8 * 8 * 6))
    shuffled.advance_to(0.01)
    for one, other in zip(expected, state(shuffled), strict=True):
        np.testing.assert_array_equal(one, other)


def test_advancing_lands_on_the_time_in_equal_steps():
    sim = stirred()
    frame = 1.0 / 300.0
    for k in range(1, 4):
        steps = sim.steps
        sim.advance_to(k * frame)
        assert sim.time == k * frame
        # The last step is as long as the mean one: no sliver at the end of a frame.
        assert sim.last_step == pytest.approx(frame / (sim.steps - steps), rel=0.1)


def test_a_step_is_never_longer_than_what_remains_nor_than_its_limits():
    sim = stirred()
    sim.step(1e-7)
    assert sim.last_step == 1e-7
    sim.step_limit = 3e-6
    sim.step(1.0)
    assert sim.last_step == pytest.approx(3e-6, rel=1e-5)
    assert sim.last_step <= 3e-6
    sim.step_limit = np.inf
    sim.step(1.0)
    assert sim.last_step == pytest.approx(0.4 * 0.5 * R / SOUND, rel=0.3)


def test_advancing_to_the_present_takes_no_step():
    sim = stirred()
    sim.advance_to(1e-3)
    steps = sim.steps
    sim.advance_to(1e-3)
    assert sim.steps == steps


@pytest.mark.parametrize("time", [0.5e-3, 0.0, -1.0, np.nan, np.inf, "soon", None, [2e-3, 3e-3]])
def test_a_time_that_is_past_or_none_is_refused_and_the_clock_stays(time):
    sim = stirred()
    sim.advance_to(1e-3)
    steps = sim.steps
    with pytest.raises(InputError, match=r"^advance_to: .*; allowed: ") as error:
        sim.advance_to(time)
    assert "\n" not in str(error.value)
    assert (sim.time, sim.steps) == (1e-3, steps)


@pytest.mark.parametrize(
    "wrong",
    [np.full((3, 3), np.nan), np.full((3, 3), -np.inf), np.zeros((3, 2)), np.zeros(3), "here"],
    ids=["nan", "infinite", "plane", "flat", "word"],
)
@pytest.mark.parametrize("which", [0, 1], ids=["position", "velocity"])
def test_blood_that_is_no_numbers_is_refused_and_what_is_there_stays(wrong, which):
    sim = stirred()
    before = state(sim)
    given = [np.full((3, 3), 1e-3), np.zeros((3, 3))]
    given[which] = wrong
    for call in (sim.restart_with, lambda x, v: sim.set_blood(np.arange(3), x, v)):
        with pytest.raises(InputError, match=r"^(position|velocity) \[m.*; allowed: "):
            call(*given)
    for one, other in zip(state(sim), before, strict=True):
        np.testing.assert_array_equal(one, other)


def test_gravity_is_three_finite_numbers():
    sim = stirred()
    wrongs: tuple[Any, ...] = ((0.0, np.nan, 0.0), (0.0, 0.0), -9.81)
    for wrong in wrongs:
        with pytest.raises(InputError, match=r"^gravity \[m/s\^2\]: found "):
            sim.gravity = wrong
    assert sim.gravity == GRAVITY


class Moments(Boundary):
    """A boundary that writes down when it is asked, and for what."""

    name = "moments"

    def __init__(self, reach: float = 0.0):
        self.asked: list[str] = []
        self.reach = reach

    def before_lists(self) -> None:
        self.asked.append("before_lists")

    def before_drift(self, dt, model) -> float:
        self.asked.append("before_drift")
        return self.reach

    def compile_kernels(self, model) -> None:
        self.asked.append("compile_kernels")

    def reset(self) -> None:
        self.asked.append("reset")

    def save_state(self) -> dict:
        return {"asked": list(self.asked)}

    def load_state(self, saved) -> None:
        self.asked = list(saved["asked"])


def test_boundaries_are_asked_at_their_moments():
    moments = Moments()
    sim = stirred(boundaries=(moments,))
    sim.step(1e-5)
    sim.step(1e-5)
    assert moments.asked == ["before_lists", "before_drift", "before_drift"]
    kept = sim.save_state()
    assert kept.boundaries == {"moments": {"asked": moments.asked}}
    # A copy has the lists built anew, so that who goes on from it sums alike.
    sim.step(1e-5)
    assert moments.asked[3:] == ["before_lists", "before_drift"]
    x, v = pool()
    sim.restart_with(x, v)
    assert moments.asked[5:] == ["reset"]
    sim.compile_kernels([sim.model])
    assert moments.asked[6:] == ["compile_kernels"]
    sim.load_state(kept)
    assert moments.asked == kept.boundaries["moments"]["asked"]
    # A state that is older than a boundary leaves it as at the start; one of another is refused.
    sim.load_state(replace(kept, boundaries={}))
    assert moments.asked[3:] == ["reset"]
    with pytest.raises(InputError, match="with wings that the scene has not"):
        sim.load_state(replace(kept, boundaries={"wings": {}}))


def test_what_boundaries_move_makes_the_lists_stale():
    near, far = Moments(0.3 * SKIN), Moments(0.8 * SKIN)
    sim = stirred(boundaries=(near,))
    for _ in range(3):
        sim.step(1e-7)
    assert near.asked.count("before_lists") == 1
    sim = stirred(boundaries=(near, far))
    sim.step(1e-7)
    assert sim.neighbors.stale


def test_a_simulation_of_parts_has_no_scene_and_says_so():
    sim = stirred()
    for ask in ("scene", "vessel", "fluid", "inflow", "wounds"):
        with pytest.raises(LookupError, match=r"^this simulation "):
            getattr(sim, ask)
    assert sim.wall_motion is None


def test_a_simulation_without_blood_reaches_its_time():
    stage = plane()
    stage.put(np.zeros((0, 3)))
    sim = stage.simulation(make_model(BLOOD), GRAVITY)
    sim.advance_to(0.5)
    assert (sim.time, sim.steps) == (0.5, 0)


def test_lists_are_good_for_every_step_of_a_run():
    sim = stirred()
    count = 8 * 8 * 6
    drifted = 0.0
    for k in range(60):
        sim.step(1.0)
        if sim.neighbors.stale or k % 3:
            continue
        n, nb = sim.particles.count[None], sim.neighbors
        assert n == count
        x = sim.particles.position.to_numpy()[:n].astype(float)
        built = np.stack([f.to_numpy()[:n] for f in (nb.built.x, nb.built.y, nb.built.z)], -1)
        distance = np.linalg.norm(separations(x, x, plane().period), axis=-1)
        np.fill_diagonal(distance, np.inf)
        listed = np.zeros((n, n), bool)
        counts, index = nb.blood_count.to_numpy()[:n], nb.blood_index.to_numpy()[:n]
        row, slot = np.nonzero(np.arange(index.shape[1]) < counts[:, None])
        listed[row, index[row, slot]] = True
        assert listed[distance < R].all()
        moved = np.diagonal(np.linalg.norm(separations(x, built, plane().period), axis=-1)).max()
        assert moved <= 0.5 * SKIN * (1 + 1e-5)
        drifted = max(drifted, moved)
    assert drifted > 0.3 * SKIN


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_state_that_is_not_finite_ends_the_run_and_names_particle_and_time(value):
    sim = stirred()
    sim.advance_to(1e-3)
    steps = sim.steps
    velocity = sim.particles.velocity.to_numpy()
    row = int(np.flatnonzero(sim.particles.identity.to_numpy()[:384] == 123)[0])
    velocity[row, 1] = value
    # Physics would spoil its neighbours as well: here it alone is broken.
    names = sim.particles.identity.to_numpy()
    sim.particles.velocity.from_numpy(velocity)
    sim.model = Prescribed(np.zeros_like, 1e-4)
    with pytest.raises(RunError) as error:
        sim.step(1.0)
    x = ", ".join(f"{c:.4g}" for c in sim.particles.position.to_numpy()[row])
    assert names[row] == 123
    assert str(error.value) == (
        f"the run diverged: particle 123 is not finite (1 in all) at t = 0.001 s, step {steps}, "
        f"near ({x}) m; likely cause: the sound speed is too low for these speeds, "
        "or particles began too close"
    )


def test_a_broken_particle_is_found_with_the_physics_too():
    x, v = pool()
    v[200, 2] = np.nan
    stage = plane()
    stage.put(x, v)
    with pytest.raises(RunError, match=r"is not finite \(\d+ in all\) at t = 0 s, step 0"):
        stage.simulation(make_model(BLOOD), GRAVITY, SOUND).step(1.0)


def test_an_acceleration_that_is_not_finite_ends_the_run():
    stage = plane()
    stage.put(cubic_lattice(4, 4, 4))

    def law(x: np.ndarray) -> np.ndarray:
        a = np.zeros_like(x)
        a[17] = np.nan
        return a

    sim = stage.simulation(Prescribed(law, 1e-4))
    with pytest.raises(RunError, match=r"particle \d+ is not finite \(1 in all\) at t = 0 s"):
        sim.step(1.0)


def test_blood_that_is_too_fast_ends_the_run_and_names_particle_and_limit():
    x, v = pool()
    v[37] = [0.0, 2.0, 0.0]
    stage = plane()
    stage.put(x, v)
    sim = stage.simulation(make_model(BLOOD), GRAVITY, SOUND)
    with pytest.raises(RunError) as error:
        sim.step(1.0)
    assert re.match(
        r"the run diverged: particle 37 moves at 2 m/s, above the limit of 1\.5 m/s, "
        r"at t = 0 s, step 0, near \(0\.0005, 0\.0065, 0\.0015\) m; likely cause: the sound",
        str(error.value),
    )


@pytest.mark.parametrize(
    ("integrator", "neighbours", "cause"),
    [
        ("paper", True, "the printed integrator (Eq. 18) amplifies sound"),
        ("symplectic", True, "the sound speed is too low for these speeds"),
        ("symplectic", False, "it has no neighbours"),
    ],
)
def test_the_likely_cause_is_told_apart(integrator, neighbours, cause):
    stage = plane()
    x = cubic_lattice(4, 4, 4) if neighbours else np.array([[4.0, 4.0, 8.0]]) * D
    stage.put(x, np.tile([5.0, 0.0, 0.0], (len(x), 1)))
    sim = stage.simulation(Prescribed(np.zeros_like, 1e-4), speed_limit=1.0, integrator=integrator)
    with pytest.raises(RunError, match=re.escape(f"likely cause: {cause}")):
        sim.step(1.0)


def energy(sim: Simulation) -> float:
    """Kinetic and internal energy by brute force, above that of the lattice [J]."""
    p = sim.particles
    blood = periodic().reference(INVISCID)
    assert len(blood.x) == p.count[None]
    return blood.kinetic_energy() + blood.internal_energy()


def ring(integrator: str, steps: int) -> np.ndarray:
    """Energy of an inviscid stirred lattice without walls over equal steps, over its first."""
    x = cubic_lattice(8, 8, 8)
    stage = periodic()
    stage.put(x)
    lattice = stage.reference(INVISCID).internal_energy()
    v = 0.02 * np.random.default_rng(3).normal(size=x.shape)
    stage.put(x, v)
    sim = stage.simulation(make_model(INVISCID), speed_limit=SOUND, integrator=integrator)
    sim.step_limit = 0.1 * D / SOUND
    energies = [energy(sim) - lattice]
    for _ in range(5):
        for _ in range(steps // 5):
            sim.step(1e3)
        energies.append(energy(sim) - lattice)
    return np.array(energies) / energies[0]


def test_energy_of_inviscid_blood_does_not_grow():
    energies = ring("symplectic", 300)
    assert energies.max() < GROWTH
    assert energies.min() > 1.0 / GROWTH


def test_energy_of_inviscid_blood_grows_with_the_printed_integrator():
    energies = ring("paper", 100)
    assert np.all(np.diff(energies) > 0.0)
    assert energies[-1] > 1.5


def test_wall_carries_the_weight_of_blood_at_rest_on_it():
    x = cubic_lattice(8, 8, 6)
    stage = plane()
    stage.put(x)
    sim = stage.simulation(make_model(BLOOD), GRAVITY, SOUND)
    sim.advance_to(0.1)
    lift = []
    for k in range(1, 21):
        sim.advance_to(0.1 + 0.005 * k)
        # Forces between particles cancel: what is left of the mean is the wall's and gravity.
        lift.append(stage.in_order(stage.particles.acceleration)[:, 2].mean() + 9.81)
    assert np.mean(lift) == pytest.approx(9.81, rel=WEIGHT)
    assert sim.wall_corrections == 0
