"""Wounds: what they do to the wall, what bleeds, and what it means to close them."""

import math
from dataclasses import dataclass, field
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bleeding_tube import (
    DENSITY,
    HOLE,
    LENGTH,
    OF_ONE,
    PRESSURE,
    RADIUS,
    SIDE,
    D,
    assert_account_is_whole,
    assert_same,
    wall_of,
)
from builders import precision
from places import VESSELS
from reference import proxy_volumes
from taichi_sph.boundary.outlets import OUT_OF_BOX, SUCTION
from taichi_sph.boundary.wounds import LEAST_RADIUS, MOST_WOUNDS, Wound, Wounds
from taichi_sph.errors import InputError, RunError
from taichi_sph.fluid.calibration import calibrate
from taichi_sph.geometry.vessel import Vessel, read_vessel
from taichi_sph.particles.smoothing_kernel import WendlandC2
from taichi_sph.particles.wall import Proxies
from taichi_sph.particles.wall import proxy_volumes as wall_volumes
from taichi_sph.scene import Column, read_scene

FACET = RADIUS * (1.0 - math.cos(math.pi / 48.0))
"""How far below the round wall its 48 facets lie [m]."""
VOLUMES = 1e-9
"""Sums of some ten kernel values in double precision."""
JET = 1.2
"""Of the free jet's flow: blood packs a little closer when it is pressed."""


# Wounds, without blood


@pytest.mark.parametrize("length", [0.0, 3e-3])
def test_a_wound_knows_distances_its_area_and_its_rim(length):
    normal = np.array([0.6, 0.0, 0.8])
    begin, line = np.array([1e-3, 2e-3, -1e-3]), length * np.array([0.0, 1.0, 0.0])
    wound = Wound(begin, begin + line, normal, 1.5e-3)
    points = np.random.default_rng(0).uniform(-6e-3, 6e-3, (300, 3))
    many = begin + np.linspace(0.0, 1.0, 2001)[:, None] * line
    brute = np.linalg.norm(points[:, None] - many[None], axis=2).min(axis=1)
    np.testing.assert_allclose(wound.distance(points), brute, atol=1e-6 * (1.0 + length))
    rim = wound.rim()
    np.testing.assert_allclose(rim[0], rim[-1], atol=1e-15)
    assert np.abs((rim - begin) @ normal).max() < 1e-15
    np.testing.assert_allclose(wound.distance(rim), 1.5e-3, rtol=1e-9)
    spokes = rim - rim.mean(axis=0)
    area = 0.5 * np.abs(np.cross(spokes[:-1], spokes[1:]) @ normal).sum()
    # A polygon of 32 in the half circles takes up 0.6 % less than they do.
    assert wound.area == pytest.approx(math.pi * 1.5e-3**2 + 2.0 * 1.5e-3 * length)
    assert 0.99 * wound.area < area < wound.area


@dataclass
class Opened:
    """A vessel whose wall may be cut, without fields."""

    vessel: Vessel
    spacing: float
    kernel: WendlandC2
    blood: Any
    wounds: Wounds = field(init=False)
    outlets: dict[int, tuple] = field(default_factory=dict)
    closed: list[np.ndarray] = field(default_factory=list)

    def __post_init__(self) -> None:
        def opened(k, begin, end, normal, reach, track_droplets=False):
            self.outlets[k] = (begin, end, normal, reach)

        outlets: Any = SimpleNamespace(
            open=opened, close=lambda k: self.outlets.pop(k, None), mark_outflow=lambda: None,
            remove_rows=lambda rows, k: self.closed.append(rows),
        )  # fmt: skip
        self.wounds = Wounds(self.blood, self.vessel, outlets, 0, self.kernel, self.spacing)


@cache
def opened(name: str) -> Opened:
    """A shipped vessel."""
    scene = read_scene(VESSELS / name / "scene.toml")
    vessel = read_vessel(scene)
    spacing = scene.discretization.spacing
    kernel = WendlandC2(scene.discretization.support_ratio * spacing)
    beside = scene.discretization.wall_spacing_ratio * spacing
    setback = calibrate(kernel, spacing, beside, DENSITY).setback
    sample = vessel.sample_wall(beside, setback)
    volume = wall_volumes(sample.positions, kernel)
    zero = np.zeros(len(volume))
    given = Proxies(sample.positions, sample.normals, volume, zero, volume, zero)
    wall = SimpleNamespace(
        given=given, setback=setback, spacing=beside, largest_amplitude=0.0,
        displacement_factor=0.0,
    )  # fmt: skip
    lists = SimpleNamespace(sort_wall=lambda wall: None, stale=False)
    return Opened(vessel, spacing, kernel, SimpleNamespace(wall=wall, neighbors=lists))


def beyond(x: np.ndarray, exit_: tuple) -> np.ndarray:
    """What would leave by an exit, by the words of `taichi_sph.boundary.outlets`."""
    begin, end, normal, reach = exit_
    away = Wound(begin, end, normal, reach).distance(x)
    return ((x - begin) @ normal > 0.0) & (away < reach)


@dataclass
class Cut:
    """What a wound of two spacings somewhere does."""

    place: tuple[float, ...]
    volumes: np.ndarray
    """Volumes of the proxies about it over those by brute force."""
    bled: int
    """Of the blood in a full vessel at rest, what would count as bled."""
    clamped: int
    """And what would when the wound is clamped, away from the hole."""


@cache
def cuts(name: str) -> list[Cut]:
    """Wounds all over a shipped vessel, one at a time."""
    case, found = opened(name), []
    wall = case.blood.wall
    position, normal = wall.given[:2]
    some = np.random.default_rng(1).choice(len(position), 120, replace=False)[20:60]
    x = case.vessel.fill_column(
        Column(opening=case.vessel.openings[0].name, full=True), case.spacing
    )
    for place in (position - wall.setback * normal)[some]:
        case.wounds.reset()
        case.closed.clear()
        try:
            wound = case.wounds.open(place, 2.0 * case.spacing)
        except InputError:
            continue  # at an opening
        left, _, volume = wall.given[:3]
        # Only those that reach the hole can have changed.
        apart = np.linalg.norm(left - place, axis=1) / case.spacing
        near, wide = apart < 7.0, apart < 9.5
        exact = proxy_volumes(left[wide], case.kernel.support_radius)[near[wide]]
        bled = beyond(x, case.outlets[0])
        case.blood.particles = SimpleNamespace(
            position=SimpleNamespace(to_numpy=lambda: x), count={None: len(x)}
        )
        case.wounds.close(0)
        # Proxies that come back stand up to half a spacing beyond the rim and are the wall for
        # another half; in an edge blood has two at the same distance.
        clamped = case.closed[-1] & (wound.distance(x) > wound.radius + 1.5 * case.spacing)
        found.append(Cut(tuple(place.round(5).tolist()), volume[near] / exact, int(bled.sum()),
                         int(clamped.sum())))  # fmt: skip
    assert len(found) > 30
    return found


SHIPPED = ("box", "aortoiliac")


@pytest.mark.parametrize("name", SHIPPED)
def test_volumes_round_any_wound_are_equation_3_of_what_is_left(name):
    wrong = {c.place: np.abs(c.volumes - 1.0).max() for c in cuts(name)}
    assert {place: w for place, w in wrong.items() if w > VOLUMES} == {}


@pytest.mark.parametrize("name", SHIPPED)
def test_no_blood_in_the_vessel_counts_as_bled_through_an_open_wound(name):
    assert {c.place: c.bled for c in cuts(name) if c.bled} == {}


@pytest.mark.parametrize("name", SHIPPED)
def test_a_clamp_takes_no_blood_that_stands_before_whole_wall(name):
    assert {c.place: c.clamped for c in cuts(name) if c.clamped} == {}


# A tube that bleeds


@pytest.mark.parametrize("off", [-0.8e-3, 0.0, 1.5e-3])
def test_a_wound_is_on_the_wall_wherever_near_it_is_asked_for(sim, off):
    turn = 0.7
    outward = np.array([math.cos(turn), math.sin(turn), 0.0])
    wound = sim.wounds.open((RADIUS + off) * outward + [0.0, 0.0, 2e-3], HOLE)
    assert math.hypot(*wound.begin[:2]) == pytest.approx(RADIUS - 0.5 * FACET, abs=0.51 * FACET)
    # Aside by no more than a facet slants over the way to it.
    aside = abs(off) * math.tan(math.pi / 48.0) + FACET
    assert np.linalg.norm(wound.begin - (RADIUS * outward + [0.0, 0.0, 2e-3])) < aside
    assert wound.end.tobytes() == wound.begin.tobytes()
    assert np.linalg.norm(wound.normal) == pytest.approx(1.0)
    # Facets turn by a 48th of the circle.
    assert wound.normal @ outward > math.cos(math.pi / 24.0)
    assert wound.is_open


def test_a_cut_goes_from_wall_to_wall_square_to_its_normal(sim):
    wound = sim.wounds.open(np.array([RADIUS, 0.0, -3e-3]), HOLE, np.array([4e-3, 3e-3, 3e-3]))
    for end in (wound.begin, wound.end):
        assert math.hypot(*end[:2]) == pytest.approx(RADIUS, abs=FACET * 1.01)
    assert abs(wound.normal @ (wound.end - wound.begin)) < 1e-15
    middle = wound.begin + wound.end
    assert wound.normal @ [*(middle[:2] / math.hypot(*middle[:2])), 0.0] > 0.9


REFUSED = {
    "too small": (
        SIDE, 1.4 * D,
        "wound: a radius of 0.00168 m is less than 1.5 spacings of the blood, so that none would "
        "pass; allowed: 0.0018 m or more",
    ),
    "in the middle": (
        np.array([0.0, 0.0, 5e-3]), 2.0 * D,
        "wound: the wall is 0.00499 m away; allowed: a point no farther from it than 0.0048 m",
    ),
    "far away": (
        np.array([0.105, 0.0, 0.0]), 2.0 * D,
        "wound: the wall is 0.1 m away; allowed: a point no farther from it than 0.0048 m",
    ),
    "on an open end": (
        np.array([0.0, 0.0, 10e-3]), 2.0 * D, "wound: that is opening 'top', not the wall"
    ),
    "on a shut end": (
        np.array([1e-3, 0.0, -10e-3]), 2.0 * D, "wound: that is opening 'bottom', not the wall"
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", REFUSED)
def test_a_wound_that_cannot_be_is_refused_in_one_sentence_and_changes_nothing(sim, mistake):
    centre, radius, message = REFUSED[mistake]
    before = wall_of(sim)
    with pytest.raises(InputError) as error:
        sim.wounds.open(centre, radius)
    assert str(error.value) == message
    assert len(sim.wounds) == 0
    assert_same(wall_of(sim), before)


def test_a_cut_whose_other_end_is_away_from_the_wall_is_refused(sim):
    with pytest.raises(InputError, match=r"^wound: the wall is 0\.0\d+ m away; "):
        sim.wounds.open(SIDE, HOLE, np.array([3.0 * RADIUS, 0.0, 0.0]))


def test_one_wound_too_many_is_refused_closed_ones_counted(sim):
    for k in range(MOST_WOUNDS):
        sim.wounds.open(SIDE, LEAST_RADIUS * D)
        sim.wounds.close(k)
    with pytest.raises(InputError) as error:
        sim.wounds.open(SIDE, HOLE)
    assert str(error.value) == f"wound: a session has at most {MOST_WOUNDS}"


@pytest.mark.parametrize("end", [None, np.array([4e-3, -3e-3, -2e-3])], ids=["puncture", "cut"])
def test_the_wall_loses_the_proxies_of_the_hole_and_no_others(sim, end):
    position, normal = sim.wall.given[:2]
    wound = sim.wounds.open(SIDE, HOLE, end)
    # A proxy stands for the wall half a spacing round where it was set back from.
    feet = position - sim.wall.setback * normal
    many = wound.begin + np.linspace(0.0, 1.0, 2001)[:, None] * (wound.end - wound.begin)
    away = np.linalg.norm(feet[:, None] - many[None], axis=2).min(axis=1)
    lost = away < HOLE + 0.5 * D
    assert np.abs(away - HOLE - 0.5 * D).min() > 1e-6 * D
    # Through this hole a wall across the tube is out of reach.
    assert np.all(normal[lost] @ wound.normal > 0.0)
    left, _, volume = sim.wall.given[:3]
    np.testing.assert_array_equal(left, position[~lost])
    assert lost.sum() == pytest.approx(Wound(*_line(wound), HOLE + 0.5 * D).area / D**2, rel=0.3)
    np.testing.assert_allclose(volume, proxy_volumes(left, 2.0 * D), rtol=VOLUMES)
    # So have the lists.
    starts = sim.neighbors.proxies.cell_start.to_numpy()
    assert starts[-1] == len(left)
    listed = np.stack([f.to_numpy() for f in (sim.neighbors.proxies.x, sim.neighbors.proxies.y,
                                              sim.neighbors.proxies.z)], axis=1)  # fmt: skip
    apart = np.linalg.norm(listed[: len(left), None] - left[None], axis=2)
    assert sorted(apart.argmin(axis=1).tolist()) == list(range(len(left)))
    assert apart.min(axis=1).max() < {"f64": 1e-15, "f32": 1e-8}[precision()]


def _line(wound: Wound) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return wound.begin, wound.end, wound.normal


def test_two_wounds_that_overlap_and_one_clamped_leave_the_other(sim):
    sim.wounds.open(SIDE, HOLE)
    alone = wall_of(sim)
    sim.wounds.open(SIDE + [0.0, 0.0, 1.5 * HOLE], HOLE)
    both = sim.wall.given
    np.testing.assert_allclose(both[2], proxy_volumes(both[0], 2.0 * D), rtol=VOLUMES)
    sim.wounds.close(1)
    # Volumes were summed anew, of the same proxies.
    assert_same(wall_of(sim), alone)
    np.testing.assert_allclose(
        sim.wall.given[2], proxy_volumes(sim.wall.given[0], 2.0 * D), rtol=VOLUMES
    )


def test_a_clamp_makes_the_wall_whole_bit_for_bit(sim):
    before = wall_of(sim)
    sim.wounds.open(SIDE, HOLE)
    sim.wounds.open(-SIDE, HOLE, np.array([-4e-3, 3e-3, 0.0]))
    assert len(sim.wall.given[0]) < sim.wall.count
    sim.wounds.close()
    assert_same(wall_of(sim), before)
    assert [w.is_open for w in sim.wounds] == [False, False]
    sim.wounds.close(0)
    assert_same(wall_of(sim), before)


@pytest.mark.parametrize(("wounds", "has"), [(0, "none yet"), (2, "0 to 1")])
def test_a_clamp_on_a_wound_that_is_not_there_is_one_sentence(sim, wounds, has):
    for _ in range(wounds):
        sim.wounds.open(SIDE, HOLE)
    for number in (-1, wounds, 99):
        with pytest.raises(InputError) as error:
            sim.wounds.close(number)
        assert str(error.value) == f"clamp: there is no wound {number}; there are {has}"


@pytest.mark.validation
def test_blood_leaves_through_a_wound_is_counted_and_no_faster_than_a_free_jet(sim):
    sim.advance_to(0.04)
    assert sim.outlets.outflow_counts()[2:].sum() == sim.outlets.outflow_counts()[2]
    wound = sim.wounds.open(SIDE, HOLE)
    begin = sim.time
    place = 2 + len(sim.vessel.openings)
    counts = []
    for frame in range(2, 6):
        sim.advance_to(begin + 0.01 * frame)
        assert_account_is_whole(sim)
        counts.append(int(sim.outlets.outflow_counts()[place]))
    assert np.all(np.diff([0, *counts]) > 0)
    account = sim.outlets.outflow_counts()
    assert account[OUT_OF_BOX] == 0
    assert account[[SUCTION, 3]].tolist() == [0, 0]
    figures = sim.diagnostics()
    assert figures.leaks == 0
    assert figures.bled_volume == pytest.approx(counts[-1] * OF_ONE)
    # Torricelli, with the highest pressure there is and a hole half a spacing wider.
    head = PRESSURE / DENSITY + 9.81 * LENGTH
    area = math.pi * (wound.radius + 0.5 * D) ** 2
    jet = area * math.sqrt(2.0 * head) * 0.03 / OF_ONE
    assert 0.1 * jet < counts[-1] - counts[0] < JET * jet
    # It drops from the hole's side, down.
    drops = sim.outlets.droplets()
    assert len(drops) == counts[-1]
    assert drops[:, 0].min() > RADIUS


@pytest.mark.validation
def test_a_clamp_stops_the_bleeding_whenever_it_comes_and_throws_nobody_out(sim):
    place = 2 + len(sim.vessel.openings)
    fastest = math.sqrt(2.0 * (PRESSURE / DENSITY + 9.81 * LENGTH))
    sim.advance_to(0.04)
    sim.wounds.open(SIDE, HOLE)
    speeds = {}
    for frame in range(4):
        time = 0.06 + 0.003 * frame
        sim.advance_to(time)
        kept = sim.save_state()
        open_ = int(sim.outlets.outflow_counts()[place])
        sim.wounds.close(0)
        clamped = int(sim.outlets.outflow_counts()[place])
        assert clamped >= open_ > 0
        assert_account_is_whole(sim)
        speeds[time] = 0.0
        try:
            for _ in range(30):
                sim.step(1.0)
                speed = float(np.linalg.norm(sim.velocities(), axis=1).max())
                speeds[time] = max(speeds[time], speed)
        except RunError:
            speeds[time] = math.inf
        assert int(sim.outlets.outflow_counts()[place]) == clamped
        assert_account_is_whole(sim)
        assert sim.diagnostics().leaks == 0
        sim.load_state(kept)
    # Blood that is stopped turns aside; it gets no faster than the jet that it was, or twice that
    # where two streams meet.
    assert {time: speed for time, speed in speeds.items() if speed > 2.0 * fastest} == {}
