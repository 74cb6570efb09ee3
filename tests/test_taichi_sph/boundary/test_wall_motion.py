"""A wall that pulses: where it is, what blood is told of it, and what it refuses."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from app.run.loop import drive
from app.scenes.centreline import Tube, make_surface
from app.view.rerun_view import RerunView
from builders import precision
from meshes import write_scene
from nn.training.rollout import ReplaySimulation
from recordings import rows, static
from reference import proxy_volumes
from states import through_a_file
from taichi_sph.boundary.inflow import buffer_capacity
from taichi_sph.boundary.wall_motion import (
    LARGEST_AMPLITUDE,
    VELOCITY_WINDOW,
    WallMotion,
    read_wall_motion,
)
from taichi_sph.errors import InputError
from taichi_sph.geometry.vessel import read_vessel
from taichi_sph.particles.wall import Proxies, move_wall
from taichi_sph.scene import Blood, NewtonianTable, OpeningTable, Scene, WallTable, parse_scene
from taichi_sph.simulation import Simulation
from taichi_sph.waveform import RAMP_TIME, Waveform, common_carotid

D = 1.2e-3
RADIUS, LENGTH = 5e-3, 30e-3
"""Of the tube [m]."""
ENDS = {"top": (0.0, 0.0, 0.5 * LENGTH), "bottom": (0.0, 0.0, -0.5 * LENGTH)}
AMPLITUDE = 4e-4
"""Of the tube's wall [m]: 8 % of its radius."""
BEAT = 0.1
"""[s]"""
PLACES = {"f64": 1e-15, "f32": 2e-9}
"""Rounding of coordinates of some 20 mm [m]."""
LINE = 2e-3
"""Of a volume halfway between its two ends: a tube that is 8 % wider has proxies that lie apart
sqrt(1.08) times as far as at its narrowest there; the square of 0.04 is what a line leaves out."""
PACKING = 0.03
"""Of the lumen: how densely rows of blood fit in changes by that from one width to another where
eight lie across."""

change = msgspec.structs.replace


def widest_lumen() -> float:
    """Volume of the tube where its wall is out [m^3]."""
    z = np.linspace(-0.5 * LENGTH, 0.5 * LENGTH, 3001)
    share = np.clip((0.5 * LENGTH - np.abs(z)) / RADIUS, 0.0, 1.0)
    radius = RADIUS + AMPLITUDE * share**2 * (3.0 - 2.0 * share)
    return float(np.trapezoid(math.pi * radius**2, z))


def cosine() -> Waveform:
    time = np.linspace(0.0, BEAT, 201)
    return Waveform(time, 3.0 - 2.0 * np.cos(2.0 * math.pi * time / BEAT))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    """A tube under pressure from its top, shut at its bottom, whose wall pulses."""
    folder = tmp_path_factory.mktemp("pulse")
    mesh = make_surface(Tube(name="tube", radius=1e3 * RADIUS, length=1e3 * LENGTH, segments=48))
    wave = cosine()
    table = np.stack([wave.time, wave.factor], axis=1)
    np.savetxt(folder / "beat.csv", table, delimiter=",")
    scene = write_scene(folder, mesh, ENDS, 'opening = "top"\nfull = true', D)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        yield change(
            scene,
            openings={
                "top": OpeningTable(centre=ENDS["top"], pressure=600.0),
                "bottom": OpeningTable(centre=ENDS["bottom"], state="capped"),
            },
            gravity=(0.0, 0.0, 0.0),
            blood=Blood(rheology=NewtonianTable(viscosity=0.03)),
            wall=WallTable(pulse=AMPLITUDE, waveform="beat.csv"),
        )


@pytest.fixture(scope="module")
def pulsing(scene: Scene) -> Simulation:
    return Simulation.from_scene(scene)


@pytest.fixture
def sim(pulsing: Simulation) -> Simulation:
    pulsing.time = 0.0
    pulsing.reset()
    return pulsing


# When, and how far


@pytest.mark.parametrize("waveform", [cosine(), common_carotid()], ids=["cosine", "carotid"])
def test_the_wall_goes_from_the_surface_of_the_file_to_its_amplitude_and_no_farther(waveform):
    motion = WallMotion(AMPLITUDE, waveform)
    time = np.linspace(0.0, 3.0, 6001)
    level = np.array([motion.displacement_factor(t) for t in time])
    assert level[0] == 0.0
    assert level.min() == 0.0
    assert level.max() == pytest.approx(1.0, abs=1e-3)
    # After the rise it is the waveform, brought to 0 to 1.
    later = time >= RAMP_TIME
    wave = np.array([waveform(t) for t in time[later]])
    low, high = waveform.factor.min(), waveform.factor.max()
    np.testing.assert_allclose(level[later], (wave - low) / (high - low), rtol=1e-12)
    # The rate's integral is the level.
    rate = np.array([motion.rate(t) for t in time])
    way = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(time))])
    assert np.abs(way - level).max() < VELOCITY_WINDOW * np.abs(rate).max()
    assert np.abs(rate).max() == pytest.approx(motion.peak_rate, rel=0.02)


def test_the_wall_is_held_at_the_openings_and_free_a_radius_away(pulsing):
    motion, vessel = pulsing.wall_motion.motion, pulsing.vessel
    z = np.linspace(-0.5 * LENGTH, 0.5 * LENGTH, 61)
    turn = 2.4 * np.arange(61)
    places = np.stack([RADIUS * np.cos(turn), RADIUS * np.sin(turn), z], axis=1)
    reach = motion.amplitude_at(vessel, places)
    share = np.clip((0.5 * LENGTH - np.abs(z)) / RADIUS, 0.0, 1.0)
    # The facets' area makes the opening's radius 0.3 % less than the tube's.
    np.testing.assert_allclose(
        reach, AMPLITUDE * share**2 * (3.0 - 2.0 * share), atol=0.02 * AMPLITUDE
    )
    assert reach[0] < 1e-4 * AMPLITUDE
    assert reach[30] == AMPLITUDE


# What blood is told


def wall_of(sim: Simulation) -> tuple[np.ndarray, ...]:
    """Positions, velocities and volumes of the proxies, in the order of the grid."""
    n = len(sim.wall.given.position)
    fields = (sim.wall.position, sim.wall.velocity, sim.wall.volume)
    return tuple(f.to_numpy()[:n].astype(float) for f in fields)


def in_grid_order(sim: Simulation, level: float) -> tuple[np.ndarray, Proxies]:
    """The proxies where the formula says, matched to the rows of the grid; and all of them."""
    given = sim.wall.given
    x = given.position + level * given.amplitude[:, None] * given.normal
    found = sim.wall.position.to_numpy()[: len(x)]
    row = np.linalg.norm(found[:, None] - x[None], axis=2).argmin(axis=1)
    assert len(set(row)) == len(x)
    return x[row], Proxies(*(a[row] for a in given))


@pytest.mark.parametrize("level", [0.0, 0.3, 1.0])
def test_proxies_stand_where_the_factor_says_and_move_as_its_rate_says(sim, level):
    move_wall(sim.wall, sim.neighbors.proxies, level, 7.0)
    x, given = in_grid_order(sim, level)
    found, velocity, _ = wall_of(sim)
    np.testing.assert_allclose(found, x, atol=PLACES[precision()])
    expected = 7.0 * given.amplitude[:, None] * given.normal
    np.testing.assert_allclose(velocity, expected, atol=1e3 * PLACES[precision()])
    # Out of the lumen, where the tube is free.
    free = np.abs(x[:, 2]) < 0.5 * LENGTH - 1.2 * RADIUS
    assert free.any()
    wide = RADIUS + sim.wall.setback + level * AMPLITUDE
    np.testing.assert_allclose(np.hypot(*found[free, :2].T), wide, atol=0.02 * RADIUS)


@pytest.mark.parametrize(("level", "tolerance"), [(0.0, 1e-6), (0.5, LINE), (1.0, 1e-6)])
def test_volumes_are_those_of_the_wall_as_it_stands(sim, level, tolerance):
    move_wall(sim.wall, sim.neighbors.proxies, level, 0.0)
    x, _ = in_grid_order(sim, level)
    np.testing.assert_allclose(wall_of(sim)[2], proxy_volumes(x, 2.0 * D), rtol=tolerance)


def test_a_wider_wall_has_larger_volumes(sim):
    narrow, wide = (proxy_volumes(sim.wall.given.at(s), 2.0 * D) for s in (0.0, 1.0))
    free = np.abs(sim.wall.given.position[:, 2]) < 0.5 * LENGTH - 1.2 * RADIUS
    ratio = (wide / narrow)[free]
    # The circle grows by 8 %, less what the setback adds to its radius, the length does not.
    grown = AMPLITUDE / (RADIUS + sim.wall.setback)
    assert 1.0 + 0.5 * grown < ratio.mean() < 1.0 + 1.5 * grown


def missed(sim: Simulation, reach: float) -> tuple[int, int]:
    """Pairs of blood and proxy nearer than a reach: how many, and how many the lists lack."""
    n = sim.particles.count[None]
    x = sim.particles.position.to_numpy()[:n].astype(float)
    away = np.linalg.norm(x[:, None] - wall_of(sim)[0][None], axis=2)
    count, index = sim.neighbors.wall_count.to_numpy(), sim.neighbors.wall_index.to_numpy()
    listed = np.zeros_like(away, bool)
    for i in range(n):
        listed[i, index[i, : count[i]]] = True
    near = away < reach * (1.0 - 1e-6)
    return int(near.sum()), int((near & ~listed).sum())


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_lists_hold_every_proxy_in_reach_wherever_the_wall_is(sim, level):
    # On both sides of the wall: seen from outside it comes nearer.
    low, high = sim.vessel.bounds
    anywhere = np.random.default_rng(0).uniform(low - 3.2 * D, high + 3.2 * D, (1700, 3))
    sim.restart_with(anywhere, np.zeros_like(anywhere))
    move_wall(sim.wall, sim.neighbors.proxies, level, 0.0)
    sim.neighbors.build(sim.particles, sim.wall)
    pairs, lacking = missed(sim, sim.neighbors.support_radius + sim.neighbors.skin)
    assert pairs > 5000
    assert lacking == 0


def test_between_two_builds_no_proxy_comes_near_unseen(sim, monkeypatch):
    # From wide to narrow in 2 ms, by more than the skin, towards blood that rests.
    fast = Waveform(np.array([0.0, 2e-3, 4e-3]), np.array([0.0, 1.0, 0.0]))
    monkeypatch.setattr(sim.wall_motion, "motion", WallMotion(AMPLITUDE, fast))
    monkeypatch.setattr(sim, "speed_limit", 1e3)
    assert 1.5 * sim.neighbors.skin < AMPLITUDE
    # So far apart that they do not feel each other.
    rows = np.arange(-9e-3, 9.1e-3, 2.5 * D)
    turn = np.linspace(0.0, 2.0 * np.pi, 7)[:-1]
    z, turn = (a.ravel() for a in np.meshgrid(rows, turn))
    away = RADIUS - np.linspace(0.8, 1.9, len(z)) * D
    alone = np.stack([away * np.cos(turn), away * np.sin(turn), z], axis=1)
    sim.restart_with(alone, np.zeros_like(alone))
    sim.inflow.set_factor(0.0)
    sim.time = RAMP_TIME + 2e-3 - RAMP_TIME % 4e-3
    sim.wall_motion.reset()
    assert sim.wall.displacement_factor == pytest.approx(1.0)
    before, compared = sim.neighbors.builds, 0
    while sim.wall.displacement_factor > 0.1:
        sim.step(2e-5)
        if not sim.neighbors.stale:
            pairs, lacking = missed(sim, sim.neighbors.support_radius)
            assert lacking == 0
            compared += pairs > 10
    assert compared > 10
    assert sim.neighbors.builds > before + 1


# A run


def test_there_is_room_for_the_blood_of_the_widest_lumen(pulsing):
    inflow = pulsing.inflow
    buffers = buffer_capacity(inflow.openings, inflow.layers)
    assert pulsing.particles.capacity >= widest_lumen() / D**3 + buffers


@pytest.mark.validation
def test_a_shut_vessel_takes_in_and_gives_back_what_its_wall_makes_room_for(sim):
    sim.advance_to(1.5 * BEAT)
    wide = int((sim.identities() >= 0).sum())
    assert sim.wall.displacement_factor == pytest.approx(1.0)
    figures = sim.diagnostics()
    assert figures.leaks == 0
    assert figures.compression_p99 < 0.03
    sim.advance_to(2.0 * BEAT)
    narrow = int((sim.identities() >= 0).sum())
    assert sim.wall.displacement_factor == pytest.approx(0.0, abs=1e-9)
    assert sim.diagnostics().leaks == 0
    lumen = math.pi * RADIUS**2 * LENGTH
    room = widest_lumen() - lumen
    assert room > 3.0 * PACKING * lumen
    assert (wide - narrow) * D**3 == pytest.approx(room, abs=PACKING * lumen)


def state_of(sim: Simulation) -> list[np.ndarray]:
    p, n = sim.particles, sim.particles.count[None]
    fields = (p.identity, p.position, p.velocity, p.acceleration)
    return [f.to_numpy()[:n] for f in fields] + list(wall_of(sim))


def test_a_run_goes_on_bitwise_from_the_middle_of_a_beat(sim, tmp_path):
    sim.advance_to(0.062)
    kept = through_a_file(sim.save_state(), tmp_path)
    sim.advance_to(0.066)
    expected = state_of(sim)
    sim.reset()
    sim.advance_to(sim.time + 0.003)
    sim.load_state(kept)
    sim.advance_to(0.066)
    for a, b in zip(state_of(sim), expected, strict=True):
        assert a.tobytes() == b.tobytes()


def test_a_clamped_wound_leaves_the_wall_as_it_was_and_moving(sim):
    move_wall(sim.wall, sim.neighbors.proxies, 0.6, 3.0)
    before = wall_of(sim)
    wound = sim.wounds.open(np.array([RADIUS, 0.0, 0.0]), 2.0 * D)
    # Outside is beyond the wall at its widest.
    assert wound.lift >= AMPLITUDE + D * (1.0 - 1e-9)
    given = sim.wall.given
    assert len(given.position) < sim.wall.count
    for level, volume in ((0.0, given.volume), (1.0, given.wide_volume)):
        exact = proxy_volumes(given.at(level), 2.0 * D)
        np.testing.assert_allclose(volume, exact, rtol=1e-9)
    x, _ = in_grid_order(sim, 0.6)
    np.testing.assert_allclose(wall_of(sim)[0], x, atol=PLACES[precision()])
    sim.wounds.close()
    for a, b in zip(wall_of(sim), before, strict=True):
        assert a.tobytes() == b.tobytes()


@pytest.mark.validation
def test_a_still_wall_costs_no_field_and_does_not_move(scene):
    still = Simulation.from_scene(change(scene, wall=None))
    assert (
        still.wall.displacement.shape
        == still.wall.narrow.shape
        == still.wall.velocity.shape
        == (1,)
    )
    assert not still.wall.moves
    before = wall_of(still)[0]
    still.advance_to(0.002)
    assert wall_of(still)[0].tobytes() == before.tobytes()


def test_the_recording_shows_the_wall_where_it_is(sim, tmp_path):
    file = tmp_path / "run.rrd"
    sim.model.accelerate(sim.particles, sim.wall, sim.neighbors, sim.gravity)
    assert drive(sim, [RerunView(sim, file)], until=0.03, frame_interval=0.01).error is None
    found = rows(file, "/world/vessel", "Mesh3D:vertex_positions")
    assert sorted(found) == [0, 1, 2, 3]
    with pytest.raises(AssertionError, match="no static"):
        static(file, "/world/vessel", "Mesh3D:vertex_positions")
    assert len(static(file, "/world/vessel", "Mesh3D:triangle_indices"))
    for frame, vertices in found.items():
        x = vertices.reshape(-1, 3)
        free = np.abs(x[:, 2]) < 0.5 * LENGTH - 1.2 * RADIUS
        assert free.any()
        wide = RADIUS + sim.wall_motion.motion.displacement_factor(0.01 * frame) * AMPLITUDE
        np.testing.assert_allclose(np.hypot(*x[free, :2].T), wide, atol=1e-6)


# What is refused


def refusal(scene: Scene, **wall: Any) -> str:
    with pytest.raises(InputError) as error:
        Simulation.from_scene(change(scene, wall=WallTable(**wall)))
    return str(error.value)


def test_a_wall_that_cannot_pulse_is_refused(scene, tmp_path):
    flat = tmp_path / "flat.csv"
    flat.write_text("0,2\n1,2\n")
    said = refusal(scene, pulse=AMPLITUDE, waveform=str(flat))
    assert said == (
        f"wall.waveform: {str(flat)!r} is the same at all times; allowed: one that rises and falls"
    )
    said = refusal(scene, pulse=2e-3, waveform="common_carotid")
    most = LARGEST_AMPLITUDE * 0.5 * read_vessel(scene).narrowest
    assert "wall.pulse: 0.002 m is too far for the narrowest place" in said
    assert f"allowed: at most {most:.3g} m" in said
    assert "nowhere.csv: cannot read the waveform" in refusal(
        scene, pulse=AMPLITUDE, waveform="nowhere.csv"
    )
    assert read_wall_motion(change(scene, wall=None), read_vessel(scene)) is None


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ("pulse = 1e-4", "the key waveform is missing"),
        ('waveform = "common_carotid"', "the key pulse is missing"),
        ('pulse = -1e-4\nwaveform = "a.csv"', "wall.pulse: found -0.0001"),
        (
            'pulse = 1e-4\nwaveform = "a.csv"\nperiod = 1.0',
            "unknown key period; allowed: pulse",
        ),
    ],
)
def test_a_wrong_table_is_refused_in_one_sentence(scene, table, said):
    text = scene.text + f"\n[wall]\n{table}\n"
    with pytest.raises(InputError) as error:
        parse_scene(text, "scene.toml", Path(scene.folder), "test")
    assert said in str(error.value)


def test_a_pulsing_scene_is_not_recorded_for_training(scene):
    still = {k: change(o, pressure=None) for k, o in scene.openings.items()}
    with pytest.raises(InputError, match="wall: pulses"):
        ReplaySimulation(change(scene, openings=still), read_vessel(scene), 0)
