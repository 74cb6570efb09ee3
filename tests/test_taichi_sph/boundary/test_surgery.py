"""Surgery: wounds and what they do to the wall, what bleeds, clamps, suction, and going on."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
import trimesh

from app.scenes.centreline import Tube, make_surface
from builders import precision
from meshes import write_scene
from places import VESSELS
from reference import proxy_volumes
from taichi_sph.boundary.outlets import OUT_OF_BOX, SUCTION
from taichi_sph.boundary.surgery import LEAST_RADIUS, MOST_WOUNDS, Surgery, Wound
from taichi_sph.boundary.tool import Tool
from taichi_sph.errors import InputError, RunError
from taichi_sph.fluid.calibration import calibrate
from taichi_sph.geometry.vessel import Vessel, read_vessel
from taichi_sph.particles.smoothing_kernel import WendlandC2
from taichi_sph.particles.wall import Proxies
from taichi_sph.particles.wall import proxy_volumes as wall_volumes
from taichi_sph.scene import Blood, Column, NewtonianTable, OpeningTable, ToolTable, read_scene
from taichi_sph.simulation import DROP_TIME, SKIN, Simulation

D = 1.2e-3
RADIUS, LENGTH = 5e-3, 20e-3
"""Of the tube [m]."""
ENDS = {"top": (0.0, 0.0, 0.5 * LENGTH), "bottom": (0.0, 0.0, -0.5 * LENGTH)}
PRESSURE = 300.0
DENSITY = 1060.0
OF_ONE = D**3
"""Volume of a particle [m^3]."""
HOLE = 2.0 * D
"""Radius of a wound [m]."""
SIDE = np.array([RADIUS, 0.0, 1e-3])
"""On the tube's wall [m]."""

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
    wall: Any
    surgery: Surgery = field(init=False)
    exits: dict[int, tuple] = field(default_factory=dict)
    clamped: list[np.ndarray] = field(default_factory=list)

    def __post_init__(self) -> None:
        def opened(k, begin, end, normal, reach, track_droplets=False):
            self.exits[k] = (begin, end, normal, reach)

        exits: Any = SimpleNamespace(
            open=opened, shut=lambda k: self.exits.pop(k, None),
            mark=lambda *_: None, take=lambda blood, rows, k: self.clamped.append(rows),
            drop_count={},
        )  # fmt: skip
        lists: Any = SimpleNamespace(sort_wall=lambda wall: None, grid=None)
        self.surgery = Surgery(self.vessel, self.wall, lists, exits, 0, self.kernel, self.spacing,
                               Tool(None, np.zeros(3)))  # fmt: skip


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
    given = Proxies(sample.positions, sample.normals, volume, np.zeros(len(volume)), volume)
    wall = SimpleNamespace(
        given=given, setback=setback, spacing=beside, most_swing=0.0, level=0.0
    )  # fmt: skip
    return Opened(vessel, spacing, kernel, wall)


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
    position, normal = case.wall.given[:2]
    some = np.random.default_rng(1).choice(len(position), 120, replace=False)[20:60]
    x = case.vessel.fill_column(
        Column(opening=case.vessel.openings[0].name, full=True), case.spacing
    )
    for place in (position - case.wall.setback * normal)[some]:
        case.surgery.start_again(0.0)
        case.clamped.clear()
        try:
            wound = case.surgery.wound(place, 2.0 * case.spacing)
        except InputError:
            continue  # at an opening
        left, _, volume = case.wall.given[:3]
        # Only those that reach the hole can have changed.
        apart = np.linalg.norm(left - place, axis=1) / case.spacing
        near, wide = apart < 7.0, apart < 9.5
        exact = proxy_volumes(left[wide], case.kernel.support_radius)[near[wide]]
        bled = beyond(x, case.exits[0])
        blood: Any = SimpleNamespace(
            position=SimpleNamespace(to_numpy=lambda: x), count={None: len(x)}
        )
        case.surgery.clamp(0, blood, 0.0)
        # Proxies that come back stand up to half a spacing beyond the rim and are the wall for
        # another half; in an edge blood has two at the same distance.
        clamped = case.clamped[-1] & (wound.distance(x) > wound.radius + 1.5 * case.spacing)
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


@pytest.fixture(scope="module")
def tube(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Simulation]:
    """A tube under pressure from its top, shut at its bottom, a ball in it as the tool."""
    folder = tmp_path_factory.mktemp("tube")
    mesh = make_surface(Tube(name="tube", radius=1e3 * RADIUS, length=1e3 * LENGTH, segments=48))
    scene = write_scene(folder, mesh, ENDS, 'opening = "top"\nfull = true', D)
    trimesh.creation.icosphere(subdivisions=2, radius=2e-3).export(folder / "tool.ply")
    scene = msgspec.structs.replace(
        scene,
        gravity=(0.0, 0.0, -9.81),
        openings={
            "top": OpeningTable(centre=ENDS["top"], pressure=PRESSURE),
            "bottom": OpeningTable(centre=ENDS["bottom"], state="capped"),
        },
        blood=Blood(density=DENSITY, rheology=NewtonianTable(viscosity=3.5e-3)),
        tool=ToolTable(surface="tool.ply", position=(0.0, 0.0, -5e-3)),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        yield Simulation.from_scene(scene)


@pytest.fixture
def sim(tube: Simulation) -> Simulation:
    """The tube as at its start."""
    tube.reset()
    tube.time = 0.0
    tube.surgery.start_again(0.0)
    tube.exits.drop_count[None] = 0
    return tube


def wall_of(sim: Simulation) -> list[np.ndarray]:
    """All that blood knows of the wall and the tool: rows that no list can name are left out."""
    w, lists = sim.wall, sim.neighbors.proxies
    starts = lists.cell_start.to_numpy()
    named = np.r_[: starts[-1], w.count : w.count + w.tool]
    rows = [f.to_numpy()[named] for f in (w.position, w.normal, w.volume, w.velocity)]
    return [*rows, *(f.to_numpy()[: starts[-1]] for f in (lists.x, lists.y, lists.z)), starts]


def assert_same(one: list[np.ndarray], other: list[np.ndarray]) -> None:
    for a, b in zip(one, other, strict=True):
        assert a.tobytes() == b.tobytes()


def assert_account_is_whole(sim: Simulation) -> None:
    names = sim.particles.identity.to_numpy()[: sim.particles.count[None]]
    live = int((names >= 0).sum())
    assert live == len(sim._initial) + sim.added - int(sim.exits.account().sum())


@pytest.mark.parametrize("off", [-0.8e-3, 0.0, 1.5e-3])
def test_a_wound_is_on_the_wall_wherever_near_it_is_asked_for(sim, off):
    turn = 0.7
    outward = np.array([math.cos(turn), math.sin(turn), 0.0])
    wound = sim.wound((RADIUS + off) * outward + [0.0, 0.0, 2e-3], HOLE)
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
    wound = sim.wound(np.array([RADIUS, 0.0, -3e-3]), HOLE, np.array([4e-3, 3e-3, 3e-3]))
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
        sim.wound(centre, radius)
    assert str(error.value) == message
    assert sim.surgery.wounds == []
    assert_same(wall_of(sim), before)


def test_a_cut_whose_other_end_is_away_from_the_wall_is_refused(sim):
    with pytest.raises(InputError, match=r"^wound: the wall is 0\.0\d+ m away; "):
        sim.wound(SIDE, HOLE, np.array([3.0 * RADIUS, 0.0, 0.0]))


def test_one_wound_too_many_is_refused_closed_ones_counted(sim):
    for k in range(MOST_WOUNDS):
        sim.wound(SIDE, LEAST_RADIUS * D)
        sim.clamp(k)
    with pytest.raises(InputError) as error:
        sim.wound(SIDE, HOLE)
    assert str(error.value) == f"wound: a session has at most {MOST_WOUNDS}"


@pytest.mark.parametrize("end", [None, np.array([4e-3, -3e-3, -2e-3])], ids=["puncture", "cut"])
def test_the_wall_loses_the_proxies_of_the_hole_and_no_others(sim, end):
    position, normal = sim.wall.given[:2]
    wound = sim.wound(SIDE, HOLE, end)
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
    sim.wound(SIDE, HOLE)
    alone = wall_of(sim)
    sim.wound(SIDE + [0.0, 0.0, 1.5 * HOLE], HOLE)
    both = sim.wall.given
    np.testing.assert_allclose(both[2], proxy_volumes(both[0], 2.0 * D), rtol=VOLUMES)
    sim.clamp(1)
    # Volumes were summed anew, of the same proxies.
    assert_same(wall_of(sim), alone)
    np.testing.assert_allclose(
        sim.wall.given[2], proxy_volumes(sim.wall.given[0], 2.0 * D), rtol=VOLUMES
    )


def test_a_clamp_makes_the_wall_whole_bit_for_bit(sim):
    before = wall_of(sim)
    sim.wound(SIDE, HOLE)
    sim.wound(-SIDE, HOLE, np.array([-4e-3, 3e-3, 0.0]))
    assert len(sim.wall.given[0]) < sim.wall.count
    sim.clamp()
    assert_same(wall_of(sim), before)
    assert [w.is_open for w in sim.surgery.wounds] == [False, False]
    sim.clamp(0)
    assert_same(wall_of(sim), before)


@pytest.mark.parametrize(("wounds", "has"), [(0, "none yet"), (2, "0 to 1")])
def test_a_clamp_on_a_wound_that_is_not_there_is_one_sentence(sim, wounds, has):
    for _ in range(wounds):
        sim.wound(SIDE, HOLE)
    for number in (-1, wounds, 99):
        with pytest.raises(InputError) as error:
            sim.clamp(number)
        assert str(error.value) == f"clamp: there is no wound {number}; there are {has}"


def test_blood_leaves_through_a_wound_is_counted_and_no_faster_than_a_free_jet(sim):
    sim.advance_to(0.04)
    assert sim.exits.account()[2:].sum() == sim.exits.account()[2]
    wound = sim.wound(SIDE, HOLE)
    begin = sim.time
    place = 2 + len(sim.vessel.openings)
    counts = []
    for frame in range(2, 6):
        sim.advance_to(begin + 0.01 * frame)
        assert_account_is_whole(sim)
        counts.append(int(sim.exits.account()[place]))
    assert np.all(np.diff([0, *counts]) > 0)
    account = sim.exits.account()
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
    drops = sim.drops()
    assert len(drops) == counts[-1]
    assert drops[:, 0].min() > RADIUS


def test_a_clamp_stops_the_bleeding_whenever_it_comes_and_throws_nobody_out(sim):
    place = 2 + len(sim.vessel.openings)
    fastest = math.sqrt(2.0 * (PRESSURE / DENSITY + 9.81 * LENGTH))
    sim.advance_to(0.04)
    sim.wound(SIDE, HOLE)
    speeds = {}
    for frame in range(4):
        time = 0.06 + 0.003 * frame
        sim.advance_to(time)
        kept = sim.save_state()
        open_ = int(sim.exits.account()[place])
        sim.clamp(0)
        clamped = int(sim.exits.account()[place])
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
        assert int(sim.exits.account()[place]) == clamped
        assert_account_is_whole(sim)
        assert sim.diagnostics().leaks == 0
        sim.load_state(kept)
    # Blood that is stopped turns aside; it gets no faster than the jet that it was, or twice that
    # where two streams meet.
    assert {time: speed for time, speed in speeds.items() if speed > 2.0 * fastest} == {}


def test_suction_takes_blood_at_its_rate_and_no_more(sim):
    rate, time = 2e-6, 0.03
    sim.suck(rate, 4e-3)
    sim.advance_to(time)
    taken = int(sim.exits.account()[SUCTION])
    assert_account_is_whole(sim)
    # A particle is owed until it is whole, and taken when lists are next built: with blood at
    # 1 m/s within 0.1 ms of half their skin.
    late = rate * 0.5 * SKIN * 2.0 * D / 0.02 / OF_ONE
    assert rate * time / OF_ONE - 1.0 - late <= taken <= rate * time / OF_ONE
    assert sim.diagnostics().sucked_volume == pytest.approx(taken * OF_ONE)
    sim.suck(0.0)
    sim.advance_to(time + 0.005)
    assert int(sim.exits.account()[SUCTION]) == taken


def test_suction_that_reaches_no_blood_owes_none(sim):
    sim.suck(1e-4, 1e-4)
    sim.advance_to(0.004)
    assert int(sim.exits.account()[SUCTION]) == 0
    sim.suck(1e-4, 4e-3)
    sim.advance_to(0.0041)
    assert int(sim.exits.account()[SUCTION]) <= 1 + math.ceil(1e-4 * 0.004 / OF_ONE * 0.1)


def test_a_mere_tip_has_the_lists_built_only_where_it_sucks(sim, monkeypatch):
    tool = Tool(None, sim.surgery.tool.position)
    monkeypatch.setattr(sim.surgery, "tool", tool)
    sim.move_tool(tool.position + [0.0, 0.0, 1e-3])
    assert sim.surgery.before_drift(1e-3) == 0.0
    sim.suck(1e-6)
    sim.move_tool(tool.position + [0.0, 0.0, 1e-3])
    assert sim.surgery.before_drift(1e-3) == pytest.approx(1e-3)
    assert sim.surgery.before_drift(1e-3) == 0.0


def state_of(sim: Simulation) -> tuple[list[np.ndarray], dict]:
    """All that is to be the same bit by bit."""
    kept = sim.save_state()
    order = np.argsort(kept.identity)
    rows = [getattr(kept, name)[order] for name in
            ("identity", "position", "velocity", "acceleration", "density")]  # fmt: skip
    return [kept.removed, *rows, *wall_of(sim)], kept.controls


def test_a_session_goes_on_bitwise_with_wounds_suction_a_moving_tool_and_a_tilt(sim):
    sim.advance_to(0.02)
    sim.wound(-SIDE, HOLE)
    sim.wound(SIDE, HOLE, np.array([4e-3, 3e-3, 2e-3]))
    sim.suck(3e-6, 4e-3)
    sim.gravity = (1.0, 2.0, -9.0)
    sim.drive(0.7)
    sim.move_tool(np.array([1e-3, -1e-3, 0.0]), np.array([0.8, 0.0, 0.6, 0.0]))
    sim.advance_to(0.026)
    sim.clamp(0)
    sim.advance_to(0.03)
    kept = sim.save_state()
    # As a file keeps it.
    controls = msgspec.json.decode(msgspec.json.encode(kept.controls))
    assert controls == kept.controls
    tool = sim.surgery.tool
    assert tool.velocity.any()
    assert tool.spin.any()
    sim.advance_to(0.036)
    expected, told = state_of(sim)
    at = tool.position.copy()
    assert int(sim.exits.account()[SUCTION]) > int(kept.removed[SUCTION]) > 0
    assert sim.exits.account()[5] > kept.removed[5] > 0
    # Another life between.
    sim.reset()
    sim.wound(SIDE, LEAST_RADIUS * D)
    sim.move_tool(np.array([0.0, 2e-3, 0.0]))
    sim.advance_to(sim.time + 0.002)
    sim.load_state(replace(kept, controls=controls))
    assert sim.time == 0.03
    assert [w.is_open for w in sim.surgery.wounds] == [False, True]
    sim.advance_to(0.036)
    found, tells = state_of(sim)
    assert_same(found, expected)
    assert tells == told
    assert sim.surgery.tool.position.tobytes() == at.tobytes()


def test_a_session_goes_on_bitwise_from_the_step_in_which_the_tool_arrives(sim):
    tool = sim.surgery.tool
    sim.move_tool(tool.position + [2e-7, 0.0, 0.0])
    sim.step(1.0)
    while np.linalg.norm(tool.wanted_position - tool.position) >= 1e-7:
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


def test_a_reset_gives_back_blood_wall_tool_pistons_and_account(sim):
    wall, x = wall_of(sim), sim.positions()
    sim.wound(SIDE, HOLE)
    sim.suck(1e-5, 4e-3)
    sim.gravity = (0.0, 9.81, 0.0)
    sim.drive(2.0)
    sim.move_tool(np.array([0.0, 0.0, 2e-3]))
    sim.advance_to(0.02)
    assert sim.exits.account().sum() > 0
    steps = sim.steps
    sim.reset()
    assert_same(wall_of(sim), wall)
    assert sim.positions().tobytes() == x.tobytes()
    assert not sim.velocities().any()
    assert sim.identities().tolist() == list(range(len(x)))
    assert sim.exits.account().tolist() == [0] * len(sim.exits.account())
    assert sim.gravity == (0.0, 0.0, -9.81)
    assert (sim.surgery.wounds, sim.surgery.suction_rate, sim.added) == ([], 0.0, 0)
    assert sim.surgery.tool.position.tolist() == [0.0, 0.0, -5e-3]
    assert sim.surgery.tool.at_rest
    assert [(p.level, p.speed, p.way, p.pushed, p.asked) for p in sim.pistons] == [(0, 0, 0, 0, 1)]
    # The clock goes on.
    assert (sim.time, sim.steps) == (0.02, steps)
    sim.advance_to(0.03)
    assert_account_is_whole(sim)
    assert sim.exits.account()[[SUCTION, 4]].tolist() == [0, 0]


def test_after_a_reset_no_drops_of_before_fall(sim):
    sim.advance_to(0.04)
    sim.wound(SIDE, HOLE)
    sim.advance_to(0.06)
    assert len(sim.drops()) > 0
    assert sim.time < DROP_TIME
    sim.reset()
    assert len(sim.drops()) == 0


def test_the_force_on_a_tool_is_a_mean_since_it_was_last_asked(sim):
    sim.take_force()
    sim.advance_to(0.002)
    impulse, time = sim._impulse.copy(), sim._impulse_time
    assert time == pytest.approx(0.002)
    np.testing.assert_allclose(sim.take_force(), impulse / time)
    assert sim.take_force().tolist() == [0.0, 0.0, 0.0]


def test_no_blood_begins_in_the_tool(sim):
    x = sim.positions()
    away = np.linalg.norm(x - [0.0, 0.0, -5e-3], axis=1)
    assert away.min() > 2e-3 + 0.45 * D
    # And all that is clear of it is there.
    lattice = sim.vessel.fill_column(sim.scene.column, D)
    clear = np.linalg.norm(lattice - [0.0, 0.0, -5e-3], axis=1) > 2e-3 + 0.5 * D
    inside = np.abs(x[:, 2]) < 0.5 * LENGTH
    assert inside.sum() == clear.sum()
