"""Inflow: where buffers stand, what drives them, and that no blood goes amiss."""

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
import taichi as ti
from scipy.spatial import cKDTree

from app.scenes.centreline import Tube, make_surface
from builders import float_dtype, precision
from driven_tube import ENDS, FLOW, LENGTH, OF_ONE, D, area, drive
from meshes import RADIUS, write_scene
from reference import between
from taichi_sph.assemble import SKIN, make_driven_openings
from taichi_sph.boundary.inflow import (
    FIXED_POINT_SCALE,
    HYSTERESIS,
    LEAST_APART,
    buffer_layers,
    drive_buffers,
)
from taichi_sph.boundary.outlets import OUT_OF_BOX
from taichi_sph.errors import InputError, RunError
from taichi_sph.scene import OpeningTable
from taichi_sph.simulation import Simulation
from taichi_sph.waveform import RAMP_TIME, Waveform

STAGGERED = 2.0
"""Particles by which strands at golden phases may differ from an even flow: 1.83 for up to 2000."""
LATE = 0.5 * SKIN * 2.0 + 0.05
"""Way of a buffer that may have been waiting for the next lists, half their skin and a step
[spacings]."""
COUNTING = {"f64": 1e-9, "f32": 1e-4}
"""Of accelerations: numbers of f32 lose a few of seven digits."""


def buffer_numbers(x: np.ndarray, sim: Simulation) -> np.ndarray:
    """Number of the buffer that each point belongs to by the words of `BufferRegions`, (n,)."""
    found = np.full(len(x), -1)
    depth = (buffer_layers(D, 2.0 * D) + 2) * D
    for k, inlet in enumerate(sim.inflow.openings):
        r = x - inlet.opening.centre
        along = r @ inlet.opening.normal
        aside = np.linalg.norm(r - along[:, None] * inlet.opening.normal, axis=1)
        reach = np.linalg.norm(inlet.sites - inlet.opening.centre, axis=1).max() + 1.5 * D
        found[(along > 0.0) & (along < depth) & (aside < reach)] = k
    return found


@ti.kernel
def number_of(regions: ti.template(), x: ti.types.ndarray(ndim=2), out: ti.types.ndarray(ndim=2)):
    for i in range(x.shape[0]):
        k = regions.buffer_at(ti.Vector([x[i, 0], x[i, 1], x[i, 2]]))
        inward = regions.inward_normal(k)
        out[i, 0] = ti.cast(k, float)
        for a in ti.static(range(3)):
            out[i, 1 + a] = inward[a]


def test_a_position_belongs_to_the_buffer_that_numpy_says(driven):
    generator = np.random.default_rng(1)
    x = generator.uniform(-1.5, 1.5, (20_000, 3)) * [RADIUS, RADIUS, 0.5 * LENGTH + 4.0 * D]
    x = np.ascontiguousarray(x, float_dtype())
    out = np.zeros((len(x), 4), float_dtype())
    number_of(driven.inflow.regions, x, out)
    expected = buffer_numbers(x.astype(float), driven)
    np.testing.assert_array_equal(driven.inflow.regions.number_at(x.astype(float)), expected)
    # In f32 a few lie on a face to within rounding.
    same = out[:, 0] == expected
    assert same.mean() >= {"f64": 1.0, "f32": 0.9995}[precision()]
    assert {-1, 0, 1} == set(expected.tolist())
    inward = np.array([-p.opening.normal for p in driven.inflow.openings] + [np.zeros(3)])
    np.testing.assert_allclose(out[same, 1:], inward[expected[same]], atol=1e-6)


def test_a_buffer_is_full_strands_at_golden_phases_clear_of_the_blood_in_the_vessel(driven):
    x = driven.positions()
    number_ = buffer_numbers(x, driven)
    layers = buffer_layers(D, 2.0 * D)
    apart = between(x, x)
    np.fill_diagonal(apart, np.inf)
    # Blood in the vessel has settled: its nearest are 0.6 to 0.7 of a spacing apart.
    assert apart.min() > 0.5 * D
    of_buffers = apart[np.ix_(number_ >= 0, number_ >= 0)]
    assert of_buffers.min() > 0.8 * D
    for k, inlet in enumerate(driven.inflow.openings):
        inside = x[number_ == k]
        # Those of the first layer that stood on the lattice of the vessel are left out.
        count = len(inlet.sites)
        assert (layers - 1) * count <= len(inside) <= layers * count
        r = inside - inlet.opening.centre
        depth = r @ inlet.opening.normal / D
        strand = between(r - np.outer(depth * D, inlet.opening.normal),
                         inlet.sites - inlet.opening.centre).argmin(axis=1)  # fmt: skip
        phase = (strand * (math.sqrt(5.0) - 1.0) / 2.0) % 1.0
        whole = depth + phase
        # In f32 positions are known to 1e-6 of a spacing.
        np.testing.assert_allclose(whole, np.rint(whole), atol=1e-5)
        assert 0.0 < depth.min() < depth.max() < layers + 1e-5


def control_of(sim: Simulation, *rows: tuple[float, float, float, float]) -> np.ndarray:
    return np.array(rows, float_dtype())


def test_buffers_get_the_mean_acceleration_and_the_push_whatever_the_order_of_the_rows(driven):
    generator, particles = np.random.default_rng(2), driven.particles
    n, dt, force = 1200, 1e-3, 3.0
    x = generator.uniform(-1.0, 1.0, (n, 3)) * [RADIUS, RADIUS, 0.5 * LENGTH + 4.0 * D]
    x = x.astype(float_dtype()).astype(float)
    a = (50.0 * generator.normal(size=(n, 3))).astype(float_dtype()).astype(float)
    speeds, counts = [], []
    for order in (np.arange(n), generator.permutation(n), np.arange(n)[::-1]):
        particles.replace(
            {"identity": np.arange(n), "position": x[order], "acceleration": a[order]}
        )
        control = control_of(driven, (1.0, 200.0, force, 0.1), (1.0, -100.0, -force, -0.2))
        drive_buffers(particles, driven.inflow, control, dt)
        speeds.append(driven.inflow.speed.to_numpy())
        np.testing.assert_array_equal(control[:, 3], speeds[-1])
        counts.append(driven.inflow.particle_count.to_numpy())
    for other in speeds[1:]:
        np.testing.assert_array_equal(other, speeds[0])
    found = buffer_numbers(x, driven)
    for k, (inlet, push, g, u) in enumerate(
        zip(driven.inflow.openings, (200.0, -100.0), (force, -force), (0.1, -0.2), strict=True)
    ):
        inside = found == k
        assert counts[0][k] == inside.sum() > 100
        mean = (a[inside] @ -inlet.opening.normal).mean()
        expected = u + dt * (mean - g + push / inside.sum())
        assert speeds[0][k] == pytest.approx(
            expected, abs=dt / FIXED_POINT_SCALE + COUNTING[precision()]
        )


def test_a_given_flow_is_the_speed_whatever_blood_does(driven):
    control = control_of(driven, (0.0, 0.3, 5.0, 9.0), (0.0, -0.1, 5.0, 9.0))
    drive_buffers(driven.particles, driven.inflow, control, 1e-3)
    np.testing.assert_array_equal(
        driven.inflow.speed.to_numpy(), np.array([0.3, -0.1], float_dtype())
    )


def test_strands_add_at_their_far_ends_as_they_have_moved_and_trembling_adds_nothing(driven):
    inflow, (inlet, _) = driven.inflow, driven.inflow.openings
    generator, layers = np.random.default_rng(3), buffer_layers(D, 2.0 * D)
    golden = (np.arange(len(inlet.sites)) * (math.sqrt(5.0) - 1.0) / 2.0) % 1.0
    displacement, added = 0.0, 0
    for goal in (3.0, 2.9, 3.1, -2.5, 4.0):
        while abs(goal - displacement) > 0.02:
            displacement += math.copysign(0.05 * generator.random(), goal - displacement)
            before = inlet.emitted.copy()
            inlet.displacement = displacement * D
            x, v = inflow.new_blood()
            moved = displacement + golden
            # A strand's last particle is within the last layer, or HYSTERESIS beyond it.
            assert np.all(moved - inlet.emitted <= 1.0)
            assert np.all(moved - inlet.emitted >= -HYSTERESIS - 0.05)
            due = inlet.emitted > before
            assert len(x) == len(v) == due.sum()
            depth = (x - inlet.opening.centre) @ inlet.opening.normal / D
            np.testing.assert_allclose(depth, layers - (moved - inlet.emitted)[due], rtol=1e-9)
            assert np.all((depth > layers - 0.05) & (depth <= layers))
            side = x - np.outer(depth * D, inlet.opening.normal)
            np.testing.assert_allclose(side, inlet.sites[due], atol=1e-12)
            added += len(x)
        even = len(inlet.sites) * displacement
        if goal == 3.0:
            assert abs(added - even) <= STAGGERED + 0.02 * len(inlet.sites)
            so_far = added
        if goal == 3.1:
            # Back by a tenth and on by two: no more than the new tenth brings.
            assert added - so_far <= 0.12 * len(inlet.sites) + STAGGERED
    assert abs(
        inlet.emitted.sum() - len(inlet.sites) * displacement
    ) <= STAGGERED + HYSTERESIS * len(inlet.sites)


def assert_account_is_whole(sim: Simulation, initial: int) -> None:
    live = sim.particles.count[None] - int(
        (sim.particles.identity.to_numpy()[: sim.particles.count[None]] < 0).sum()
    )
    assert live == initial + sim.inflow.added - int(sim.outlets.outflow_counts().sum())
    names = sim.identities()
    assert len(np.unique(names)) == len(names)


@pytest.mark.validation
def test_the_account_closes_and_what_is_added_is_what_the_pump_pushes(driven):
    initial = driven.particles.count[None]
    names = set(driven.identities().tolist())
    count, end = len(driven.inflow.openings[0].sites), 0.06
    for frame in range(1, 7):
        driven.advance_to(end * frame / 6)
        assert_account_is_whole(driven, initial)
        t = driven.time
        rising = min(1.0, t / RAMP_TIME)
        assert driven.inflow.speed[0] == pytest.approx(FLOW * rising / area(driven), rel=1e-6)
        pushed = FLOW * (t - 0.5 * RAMP_TIME if t > RAMP_TIME else 0.5 * t**2 / RAMP_TIME)
        # The speed at the end of each step for all of it: half a step's flow more, at most.
        assert driven.inflow.openings[0].volume_in == pytest.approx(
            pushed, abs=0.6 * FLOW * 1e-4 + 1e-3 * pushed
        )
    assert driven.inflow.openings[0].emitted.sum() > 200
    # Nothing was crowded out: what strands took is what was added, of both buffers.
    gained = sum(int(np.maximum(p.emitted, 0).sum()) for p in driven.inflow.openings)
    assert driven.inflow.added == gained
    bound = STAGGERED + LATE * count
    assert (
        abs(driven.inflow.openings[0].emitted.sum() - driven.inflow.openings[0].volume_in / OF_ONE)
        < bound
    )
    # It came out at the other end, through the buffer there, and nowhere else.
    account = driven.outlets.outflow_counts()
    assert account[OUT_OF_BOX] == 0
    assert account[2:].sum() == account[3] > 100
    assert driven.diagnostics().leaks == 0
    assert driven.diagnostics().added_volume == pytest.approx(driven.inflow.added * OF_ONE)
    # New blood has new names, one after the other.
    assert driven.identities().max() == initial + driven.inflow.added - 1
    assert not names >= set(driven.identities().tolist())


def test_a_waveform_multiplies_the_flow(driven):
    drive(driven, "top", flow=FLOW,
          waveform=Waveform(np.array([0.0, 0.01, 0.03]), np.array([0.0, 1.0, 0.0])))  # fmt: skip
    driven.inflow.openings[0].factor = 1.0
    for time, factor in ((0.005, 0.5), (0.01, 1.0), (0.02, 0.5), (0.035, 0.5)):
        driven.advance_to(time)
        expected = FLOW * factor / area(driven)
        assert driven.inflow.openings[0].speed == pytest.approx(expected, rel=1e-6)


def test_a_flow_that_turns_neither_leaks_nor_adds_blood_on_top_of_other(driven):
    # Out and in again by five spacings, more than the buffer's length; the reservoir follows.
    period = 0.12
    time = np.linspace(0.0, period, 61)
    turning = Waveform(time, np.sin(2.0 * np.pi * time / period))
    drive(driven, "top", flow=-0.5 * FLOW, waveform=turning)
    drive(driven, "bottom", pressure=250.0)
    driven.inflow.openings[0].factor = 1.0
    initial = driven.particles.count[None]
    least, ways, known = np.inf, [], initial

    def look() -> None:
        """How near the latest blood was put to other; blood of a buffer keeps its distances."""
        nonlocal least, known
        if initial + driven.inflow.added > known:
            x, names = driven.positions(), driven.identities()
            apart, _ = cKDTree(x).query(x[names >= known], k=2)
            least = min(least, float(apart[:, 1].min()))
            known = initial + driven.inflow.added

    for frame in range(1, 25):
        driven.advance_to(period * frame / 24, look)
        assert_account_is_whole(driven, initial)
        ways.append(driven.inflow.openings[0].displacement / D)
    assert min(ways) < -4.0
    assert max(ways[-3:]) - min(ways) > 4.0
    assert LEAST_APART * D * (1.0 - 1e-5) <= least < D
    account = driven.outlets.outflow_counts()
    assert account[OUT_OF_BOX] == 0
    # Out through the buffer's far end and in again.
    assert account[2] > 100
    assert driven.inflow.added > 100
    assert driven.diagnostics().leaks == 0


def test_a_vessel_that_is_over_full_is_one_sentence(driven):
    capacity = driven.particles.capacity
    generator = np.random.default_rng(4)
    x = generator.uniform(-0.5, 0.5, (capacity, 3)) * [RADIUS, RADIUS, LENGTH]
    driven.restart_with(x, np.zeros_like(x))
    driven.inflow.openings[0].displacement = 2.0 * D
    with pytest.raises(RunError) as error:
        driven.step(1.0)
    assert str(error.value) == (
        f"the run diverged: at t = 0 s the vessel is over-full, {capacity} particles; likely "
        "cause: more is driven in than can leave, or the pressure is too high for the sound speed"
    )


def test_an_opening_that_nothing_drives_cannot_be_turned_up(driven):
    with pytest.raises(InputError) as error:
        driven.inflow.set_factor(2.0, "side")
    assert str(error.value) == "inflow: nothing drives side; driven: top, bottom"


@pytest.mark.parametrize("factor", [0.0, 0.5, 2.0])
def test_a_pump_that_is_turned_gets_there_in_the_time_of_rising(driven, factor):
    driven.inflow.openings[0].factor = driven.inflow.openings[1].factor = 1.0
    driven.inflow.set_factor(factor, "top")
    factors, dt = [], RAMP_TIME / 100.0
    for _ in range(100):
        driven.inflow.before_drift(dt, driven.model)
        factors.append(driven.inflow.openings[0].factor)
    assert factors[-1] == pytest.approx(factor)
    assert np.abs(np.diff(factors)).max() <= dt / RAMP_TIME * (1.0 + 1e-9)
    assert driven.inflow.openings[1].factor == 1.0


def test_state_of_a_driven_opening_is_numbers_and_comes_back(driven):
    inlet = driven.inflow.openings[0]
    driven.advance_to(0.004)
    kept = msgspec.json.decode(msgspec.json.encode(inlet.save_state()))
    taken, speed, displacement = inlet.emitted.copy(), inlet.speed, inlet.displacement
    driven.advance_to(0.03)
    assert inlet.displacement > displacement
    inlet.load_state(kept)
    assert (inlet.speed, inlet.displacement) == (speed, displacement)
    np.testing.assert_array_equal(inlet.emitted, taken)
    assert inlet.emitted.dtype == np.int64


def test_where_a_scene_lies_does_not_matter(tmp_path: Path) -> None:
    """A waveform's file is sought beside the scene."""
    mesh = make_surface(Tube(name="tube", radius=5.0, length=15.0, segments=24))
    scene = write_scene(tmp_path, mesh, ENDS, 'opening = "top"\nfull = true', D)
    (tmp_path / "beat.csv").write_text("0,1\n1,2\n")
    table = OpeningTable(centre=ENDS["top"], flow=1e-5, waveform="beat.csv")
    scene = msgspec.structs.replace(scene, openings={**scene.openings, "top": table})
    from taichi_sph.geometry.vessel import read_vessel

    (inlet,) = make_driven_openings(scene, read_vessel(scene))
    assert inlet.waveform(0.5) == 1.5


def test_a_device_without_sums_of_wide_integers_is_refused(driven, monkeypatch):
    monkeypatch.setattr("taichi_sph.boundary.inflow.has_wide_atomics", lambda: False)
    with pytest.raises(InputError, match=r"^driven openings need .* use --arch cpu$"):
        Simulation.from_scene(driven.scene, vessel=driven.vessel)


def test_an_opening_too_narrow_for_one_particle_is_one_sentence(driven):
    scene = driven.scene
    coarse = msgspec.structs.replace(scene.discretization, spacing=3.0 * RADIUS)
    scene = msgspec.structs.replace(scene, discretization=coarse)
    with pytest.raises(InputError) as error:
        make_driven_openings(scene, driven.vessel)
    assert str(error.value) == "openings.top: too narrow to be driven at spacing 0.015 m"
