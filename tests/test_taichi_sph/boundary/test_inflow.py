"""Pistons: where plugs and sleeves stand, what drives them, and that no blood goes amiss."""

import math
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import taichi as ti
from scipy.spatial import cKDTree

from app.scenes.centreline import Tube, make_surface
from builders import float_dtype, precision
from meshes import RADIUS, write_scene
from taichi_sph.boundary.inflow import (
    FIXED_POINT_SCALE,
    HYSTERESIS,
    LEAST_APART,
    RAMP_TIME,
    buffer_layers,
    buffer_sites,
    drive_buffers,
    flow_extension,
    rim_distance,
)
from taichi_sph.boundary.outlets import OUT_OF_BOX
from taichi_sph.errors import InputError, RunError
from taichi_sph.geometry.mesh import plane_axes
from taichi_sph.geometry.openings import Opening
from taichi_sph.scene import Blood, NewtonianTable, OpeningTable
from taichi_sph.simulation import SKIN, Simulation, make_pistons
from taichi_sph.waveform import STEADY, Waveform

D = 1.2e-3
LENGTH = 15e-3
"""Of the tube; its radius is 5 mm [m]."""
ENDS = {"top": (0.0, 0.0, 0.5 * LENGTH), "bottom": (0.0, 0.0, -0.5 * LENGTH)}
FLOW = 2e-5
DENSITY = 1060.0
VISCOSITY = 0.05
"""Fourteen times blood's, so that sound and stray flow die within 0.1 s [Pa s]."""
OF_ONE = D**3
"""Volume of a particle [m^3]."""

STAGGERED = 2.0
"""Particles by which columns at golden leads may differ from an even flow: 1.83 for up to 2000."""
LATE = 0.5 * SKIN * 2.0 + 0.05
"""Way of a plug that may have been waiting for the next lists, half their skin and a step
[spacings]."""
COUNTING = {"f64": 1e-9, "f32": 1e-4}
"""Of accelerations: numbers of f32 lose a few of seven digits."""
REST = 0.02
"""Of the jet's speed that the pressure would make, sqrt(2 p/rho): sound still rings."""
RINGING = 0.05
"""Of the pressure: its mean over a few periods of the sound that is left."""
PUSHED = 0.1
"""Of the momentum: in 1 ms the wall takes 1.5 sqrt(nu t)/R, some 7 %."""


# Sites and sleeves


def circle(radius: float, count: int = 96) -> np.ndarray:
    turn = 2.0 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)


def ellipse(radius: float) -> np.ndarray:
    return circle(radius) * [1.4, 0.8]


def bean(radius: float) -> np.ndarray:
    turn = 2.0 * np.pi * np.arange(120) / 120
    r = radius * (1.0 + 0.25 * np.cos(2.0 * turn) - 0.15 * np.cos(turn))
    return r[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)


RIMS = {"circle": circle, "ellipse": ellipse, "bean": bean}
NORMAL = np.array([0.36, -0.48, 0.8])
CENTRE = np.array([0.02, -0.01, 0.03])


def in_space(flat: np.ndarray) -> tuple[np.ndarray, Opening]:
    """A rim (n, 2) in a slanting plane, and its opening."""
    first, second = plane_axes(NORMAL)
    a, b = flat.T, np.roll(flat, -1, axis=0).T
    area = 0.5 * abs(float((a[0] * b[1] - b[0] * a[1]).sum()))
    rim = CENTRE + flat[:, :1] * first + flat[:, 1:] * second
    radius = math.sqrt(area / math.pi)
    return rim, Opening("inlet", CENTRE, NORMAL, radius, area, True)


def finely(polygon: np.ndarray) -> np.ndarray:
    """Many points on a closed polygon, twenty to an edge."""
    share = np.arange(20)[:, None, None] / 20.0
    after = np.roll(polygon, -1, axis=0)
    return (polygon + share * (after - polygon)).reshape(-1, polygon.shape[1])


def between(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.linalg.norm(x[:, None] - y[None], axis=2)


@pytest.mark.parametrize("shape", RIMS)
def test_the_distance_to_a_polygon_is_that_to_its_nearest_point(shape):
    polygon = RIMS[shape](5e-3)
    points = np.random.default_rng(0).uniform(-8e-3, 8e-3, (200, 2))
    found = rim_distance(points, polygon)
    near = between(points, finely(polygon)).min(axis=1)
    # Of points a twentieth of an edge apart the nearest is at most half of that farther.
    step = np.linalg.norm(np.roll(polygon, -1, axis=0) - polygon, axis=1).max() / 20.0
    assert np.all(found <= near + 1e-15)
    assert np.all(near - found <= 0.5 * step)


@pytest.mark.parametrize("spacing", [0.7e-3, 1.2e-3, 1.6e-3])
@pytest.mark.parametrize("shape", RIMS)
def test_sites_are_a_spacing_apart_and_half_a_spacing_inside_the_rim(shape, spacing):
    rim, opening = in_space(RIMS[shape](5e-3))
    sites = buffer_sites(rim, opening, spacing)
    assert np.abs((sites - CENTRE) @ NORMAL).max() < 1e-12
    apart = between(sites, sites)
    np.fill_diagonal(apart, np.inf)
    np.testing.assert_allclose(apart.min(axis=1), spacing, rtol=1e-9)
    rim = finely(rim)
    away = between(sites, rim)
    assert away.min() > 0.498 * spacing
    # Inside: these rims see all of themselves from their centre, and the centre from within.
    facing = (sites - CENTRE) @ (rim - CENTRE).T
    facing /= np.linalg.norm(rim - CENTRE, axis=1)
    behind = np.linalg.norm(rim - CENTRE, axis=1)[facing.argmax(axis=1)]
    assert np.all(np.linalg.norm(sites - CENTRE, axis=1) < behind)


@pytest.mark.parametrize("spacing", [0.4e-3, 0.7e-3, 1.2e-3, 1.6e-3])
@pytest.mark.parametrize("shape", RIMS)
def test_sites_take_up_the_opening_but_for_its_rim(shape, spacing):
    rim, opening = in_space(RIMS[shape](5e-3))
    taken = len(buffer_sites(rim, opening, spacing)) * spacing**2
    around = np.linalg.norm(np.roll(rim, -1, axis=0) - rim, axis=1).sum()
    # Lattice points in an area fill it but for a few; all keep half a spacing from the rim.
    few = 2.0 * spacing**2
    assert opening.area - 0.5 * around * spacing - few < taken < opening.area + few


def test_an_opening_too_narrow_for_one_particle_is_one_sentence(driven):
    scene = driven.scene
    coarse = msgspec.structs.replace(scene.discretization, spacing=3.0 * RADIUS)
    scene = msgspec.structs.replace(scene, discretization=coarse)
    with pytest.raises(InputError) as error:
        make_pistons(scene, driven.vessel)
    assert str(error.value) == "openings.top: too narrow to be driven at spacing 0.015 m"


@pytest.mark.parametrize("shape", RIMS)
def test_the_sleeve_stands_a_setback_outside_the_rim_evenly_and_faces_out(shape):
    rim, opening = in_space(RIMS[shape](5e-3))
    spacing, setback, depth = 0.7e-3, 0.65e-3, 5e-3
    points, normals = flow_extension(rim, opening, spacing, setback, depth)
    along = (points - CENTRE) @ NORMAL
    # In rings a spacing apart, the first half a spacing beyond the plane, as far as asked.
    levels = np.unique(along.round(9))
    np.testing.assert_allclose(levels, (np.arange(len(levels)) + 0.5) * spacing, atol=1e-8)
    assert depth - 0.5 * spacing <= levels[-1] < depth + 0.5 * spacing
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-12)
    assert np.abs(normals @ NORMAL).max() < 1e-12
    flat = points - along[:, None] * NORMAL
    # Chords of a spacing lie inside a rim that curves by 1/R: by spacing^2/(8 R) at most twice.
    bent = 0.05 * setback
    outline = finely(rim)
    np.testing.assert_allclose(between(flat, outline).min(axis=1), setback, atol=bent)
    assert between(flat + 0.1 * setback * normals, outline).min() > 1.05 * setback
    assert (
        np.linalg.norm(flat - CENTRE, axis=1).min() > np.linalg.norm(outline - CENTRE, axis=1).min()
    )
    # Their feet on the rim are evenly spread: as many to every piece of it.
    feet = flat - setback * normals
    ring = feet[np.abs(along - levels[1]) < 1e-9]
    step = np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1)
    assert step.max() < 1.03 * step.min()
    assert step.mean() == pytest.approx(spacing, rel=0.03)
    # Each ring stands on the gaps of the one before.
    first = feet[np.abs(along - levels[0]) < 1e-9]
    assert between(ring, first).min() > 0.45 * spacing


# A driven tube


def make_tube(folder: Path, viscosity: float) -> Simulation:
    """A short tube full of blood, a pump at its top and a reservoir at its bottom."""
    mesh = make_surface(Tube(name="tube", radius=1e3 * RADIUS, length=1e3 * LENGTH, segments=48))
    scene = write_scene(folder, mesh, ENDS, 'opening = "top"\nfull = true', D)
    scene = msgspec.structs.replace(
        scene,
        gravity=(0.0, 0.0, 0.0),
        openings={
            "top": OpeningTable(centre=ENDS["top"], flow=FLOW),
            "bottom": OpeningTable(centre=ENDS["bottom"], pressure=0.0),
        },
        blood=Blood(density=DENSITY, rheology=NewtonianTable(viscosity=viscosity)),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        return Simulation.from_scene(scene)


@pytest.fixture(scope="module")
def tube(tmp_path_factory: pytest.TempPathFactory) -> Simulation:
    """A tube of viscous blood."""
    return make_tube(tmp_path_factory.mktemp("tube"), VISCOSITY)


@pytest.fixture
def driven(tube: Simulation) -> Simulation:
    """The tube as at its start."""
    tube.reset()
    tube.time = 0.0
    tube.surgery.start_again(0.0)
    drive(tube, "top", flow=FLOW)
    drive(tube, "bottom", pressure=0.0)
    return tube


def drive(
    sim: Simulation, name: str, flow: float | None = None, pressure: float | None = None,
    waveform: Waveform = STEADY,
) -> None:  # fmt: skip
    """Let a pump or a reservoir drive an opening."""
    piston = next(p for p in sim.pistons if p.opening.name == name)
    piston.flow, piston.pressure, piston.waveform = flow, pressure, waveform


def area(sim: Simulation) -> float:
    """Cross-section of a plug: a square spacing a column [m^2]."""
    return len(sim.pistons[0].sites) * D**2


def plug_numbers(x: np.ndarray, sim: Simulation) -> np.ndarray:
    """Number of the plug that each point belongs to by the words of `BufferRegions`, (n,)."""
    found = np.full(len(x), -1)
    depth = (buffer_layers(D, 2.0 * D) + 2) * D
    for k, piston in enumerate(sim.pistons):
        r = x - piston.opening.centre
        along = r @ piston.opening.normal
        aside = np.linalg.norm(r - along[:, None] * piston.opening.normal, axis=1)
        reach = np.linalg.norm(piston.sites - piston.opening.centre, axis=1).max() + 1.5 * D
        found[(along > 0.0) & (along < depth) & (aside < reach)] = k
    return found


@ti.kernel
def number_of(gates: ti.template(), x: ti.types.ndarray(ndim=2), out: ti.types.ndarray(ndim=2)):
    for i in range(x.shape[0]):
        k = gates.buffer_at(ti.Vector([x[i, 0], x[i, 1], x[i, 2]]))
        inward = gates.inward_normal(k)
        out[i, 0] = ti.cast(k, float)
        for a in ti.static(range(3)):
            out[i, 1 + a] = inward[a]


def test_a_position_belongs_to_the_plug_that_numpy_says(driven):
    generator = np.random.default_rng(1)
    x = generator.uniform(-1.5, 1.5, (20_000, 3)) * [RADIUS, RADIUS, 0.5 * LENGTH + 4.0 * D]
    x = np.ascontiguousarray(x, float_dtype())
    out = np.zeros((len(x), 4), float_dtype())
    number_of(driven.plugs.gates, x, out)
    expected = plug_numbers(x.astype(float), driven)
    # In f32 a few lie on a face to within rounding.
    same = out[:, 0] == expected
    assert same.mean() >= {"f64": 1.0, "f32": 0.9995}[precision()]
    assert {-1, 0, 1} == set(expected.tolist())
    inward = np.array([-p.opening.normal for p in driven.pistons] + [np.zeros(3)])
    np.testing.assert_allclose(out[same, 1:], inward[expected[same]], atol=1e-6)


def test_a_plug_is_full_columns_at_golden_leads_clear_of_the_blood_in_the_vessel(driven):
    x = driven.positions()
    number_ = plug_numbers(x, driven)
    layers = buffer_layers(D, 2.0 * D)
    apart = between(x, x)
    np.fill_diagonal(apart, np.inf)
    assert apart.min() > 0.8 * D * (1.0 - 1e-6)
    for k, piston in enumerate(driven.pistons):
        inside = x[number_ == k]
        # Those of the first layer that stood on the lattice of the vessel are left out.
        count = len(piston.sites)
        assert (layers - 1) * count <= len(inside) <= layers * count
        r = inside - piston.opening.centre
        depth = r @ piston.opening.normal / D
        column = between(r - np.outer(depth * D, piston.opening.normal),
                         piston.sites - piston.opening.centre).argmin(axis=1)  # fmt: skip
        lead = (column * (math.sqrt(5.0) - 1.0) / 2.0) % 1.0
        whole = depth + lead
        # In f32 positions are known to 1e-6 of a spacing.
        np.testing.assert_allclose(whole, np.rint(whole), atol=1e-5)
        assert 0.0 < depth.min() < depth.max() < layers + 1e-5


def orders_of(sim: Simulation, *rows: tuple[float, float, float, float]) -> np.ndarray:
    return np.array(rows, float_dtype())


def test_plugs_get_the_mean_acceleration_and_the_push_whatever_the_order_of_the_rows(driven):
    generator, particles = np.random.default_rng(2), driven.particles
    n, dt, force = 1200, 1e-3, 3.0
    x = generator.uniform(-1.0, 1.0, (n, 3)) * [RADIUS, RADIUS, 0.5 * LENGTH + 4.0 * D]
    x = x.astype(float_dtype()).astype(float)
    a = (50.0 * generator.normal(size=(n, 3))).astype(float_dtype()).astype(float)
    speeds, members = [], []
    for order in (np.arange(n), generator.permutation(n), np.arange(n)[::-1]):
        particles.replace(identity=np.arange(n), position=x[order], acceleration=a[order])
        orders = orders_of(driven, (1.0, 200.0, force, 0.1), (1.0, -100.0, -force, -0.2))
        drive_buffers(particles, driven.plugs, orders, dt)
        speeds.append(driven.plugs.speed.to_numpy())
        np.testing.assert_array_equal(orders[:, 3], speeds[-1])
        members.append(driven.plugs.members.to_numpy())
    for other in speeds[1:]:
        np.testing.assert_array_equal(other, speeds[0])
    found = plug_numbers(x, driven)
    for k, (piston, push, g, u) in enumerate(
        zip(driven.pistons, (200.0, -100.0), (force, -force), (0.1, -0.2), strict=True)
    ):
        inside = found == k
        assert members[0][k] == inside.sum() > 100
        mean = (a[inside] @ -piston.opening.normal).mean()
        expected = u + dt * (mean - g + push / inside.sum())
        assert speeds[0][k] == pytest.approx(
            expected, abs=dt / FIXED_POINT_SCALE + COUNTING[precision()]
        )


def test_a_given_flow_is_the_speed_whatever_blood_does(driven):
    orders = orders_of(driven, (0.0, 0.3, 5.0, 9.0), (0.0, -0.1, 5.0, 9.0))
    drive_buffers(driven.particles, driven.plugs, orders, 1e-3)
    np.testing.assert_array_equal(
        driven.plugs.speed.to_numpy(), np.array([0.3, -0.1], float_dtype())
    )


def test_columns_add_at_their_far_ends_as_they_have_moved_and_trembling_adds_nothing(driven):
    pistons, (piston, _) = driven._pistons, driven.pistons
    generator, layers = np.random.default_rng(3), buffer_layers(D, 2.0 * D)
    golden = (np.arange(len(piston.sites)) * (math.sqrt(5.0) - 1.0) / 2.0) % 1.0
    way, added = 0.0, 0
    for goal in (3.0, 2.9, 3.1, -2.5, 4.0):
        while abs(goal - way) > 0.02:
            way += math.copysign(0.05 * generator.random(), goal - way)
            before = piston.taken.copy()
            piston.way = way * D
            x, v = pistons.new_blood()
            moved = way + golden
            # A column's last particle is within the last layer, or SLACK beyond it.
            assert np.all(moved - piston.taken <= 1.0)
            assert np.all(moved - piston.taken >= -HYSTERESIS - 0.05)
            due = piston.taken > before
            assert len(x) == len(v) == due.sum()
            depth = (x - piston.opening.centre) @ piston.opening.normal / D
            np.testing.assert_allclose(depth, layers - (moved - piston.taken)[due], rtol=1e-9)
            assert np.all((depth > layers - 0.05) & (depth <= layers))
            side = x - np.outer(depth * D, piston.opening.normal)
            np.testing.assert_allclose(side, piston.sites[due], atol=1e-12)
            added += len(x)
        even = len(piston.sites) * way
        if goal == 3.0:
            assert abs(added - even) <= STAGGERED + 0.02 * len(piston.sites)
            so_far = added
        if goal == 3.1:
            # Back by a tenth and on by two: no more than the new tenth brings.
            assert added - so_far <= 0.12 * len(piston.sites) + STAGGERED
    assert abs(piston.taken.sum() - len(piston.sites) * way) <= STAGGERED + HYSTERESIS * len(
        piston.sites
    )


def assert_account_is_whole(sim: Simulation, initial: int) -> None:
    live = sim.particles.count[None] - int(
        (sim.particles.identity.to_numpy()[: sim.particles.count[None]] < 0).sum()
    )
    assert live == initial + sim.added - int(sim.exits.account().sum())
    names = sim.identities()
    assert len(np.unique(names)) == len(names)


def test_the_account_closes_and_what_is_added_is_what_the_pump_pushes(driven):
    initial = driven.particles.count[None]
    names = set(driven.identities().tolist())
    count, end = len(driven.pistons[0].sites), 0.06
    for frame in range(1, 7):
        driven.advance_to(end * frame / 6)
        assert_account_is_whole(driven, initial)
        t = driven.time
        level = min(1.0, t / RAMP_TIME)
        assert driven.plugs.speed[0] == pytest.approx(FLOW * level / area(driven), rel=1e-6)
        pushed = FLOW * (t - 0.5 * RAMP_TIME if t > RAMP_TIME else 0.5 * t**2 / RAMP_TIME)
        # The speed at the end of each step for all of it: half a step's flow more, at most.
        assert driven.pistons[0].pushed == pytest.approx(
            pushed, abs=0.6 * FLOW * 1e-4 + 1e-3 * pushed
        )
    assert driven.pistons[0].taken.sum() > 200
    # Nothing was crowded out: what columns took is what was added, of both plugs.
    gained = sum(int(np.maximum(p.taken, 0).sum()) for p in driven.pistons)
    assert driven.added == gained
    bound = STAGGERED + LATE * count
    assert abs(driven.pistons[0].taken.sum() - driven.pistons[0].pushed / OF_ONE) < bound
    # It came out at the other end, through the plug there, and nowhere else.
    account = driven.exits.account()
    assert account[OUT_OF_BOX] == 0
    assert account[2:].sum() == account[3] > 100
    assert driven.diagnostics().leaks == 0
    assert driven.diagnostics().added_volume == pytest.approx(driven.added * OF_ONE)
    # New blood has new names, one after the other.
    assert driven.identities().max() == initial + driven.added - 1
    assert not names >= set(driven.identities().tolist())


def test_a_waveform_multiplies_the_flow(driven):
    drive(driven, "top", flow=FLOW,
          waveform=Waveform(np.array([0.0, 0.01, 0.03]), np.array([0.0, 1.0, 0.0])))  # fmt: skip
    driven.pistons[0].level = 1.0
    for time, factor in ((0.005, 0.5), (0.01, 1.0), (0.02, 0.5), (0.035, 0.5)):
        driven.advance_to(time)
        expected = FLOW * factor / area(driven)
        assert driven.pistons[0].speed == pytest.approx(expected, rel=1e-6)


def test_a_flow_that_turns_neither_leaks_nor_adds_blood_on_top_of_other(driven):
    # Out and in again by five spacings, more than the plug's length; the reservoir follows.
    period = 0.12
    time = np.linspace(0.0, period, 61)
    turning = Waveform(time, np.sin(2.0 * np.pi * time / period))
    drive(driven, "top", flow=-0.5 * FLOW, waveform=turning)
    drive(driven, "bottom", pressure=250.0)
    driven.pistons[0].level = 1.0
    initial = driven.particles.count[None]
    least, ways, known = np.inf, [], initial

    def look() -> None:
        """How near the latest blood was put to other; blood of a plug keeps its distances."""
        nonlocal least, known
        if initial + driven.added > known:
            x, names = driven.positions(), driven.identities()
            apart, _ = cKDTree(x).query(x[names >= known], k=2)
            least = min(least, float(apart[:, 1].min()))
            known = initial + driven.added

    for frame in range(1, 25):
        driven.advance_to(period * frame / 24, look)
        assert_account_is_whole(driven, initial)
        ways.append(driven.pistons[0].way / D)
    assert min(ways) < -4.0
    assert max(ways[-3:]) - min(ways) > 4.0
    assert LEAST_APART * D * (1.0 - 1e-5) <= least < D
    account = driven.exits.account()
    assert account[OUT_OF_BOX] == 0
    # Out through the plug's far end and in again.
    assert account[2] > 100
    assert driven.added > 100
    assert driven.diagnostics().leaks == 0


@pytest.fixture(scope="module")
def packed(tube: Simulation) -> tuple[list[tuple[float, float, float]], object]:
    """The tube between two reservoirs of 100 Pa: time, speeds, pressure inside; and its state."""
    tube.reset()
    tube.time = 0.0
    drive(tube, "top", pressure=100.0)
    drive(tube, "bottom", pressure=100.0)
    history = []
    for frame in range(1, 126):
        tube.advance_to(0.002 * frame)
        state = tube.fluid.equation_of_state
        x = tube.positions()
        density = tube.particles.in_order(tube.particles.density).astype(float)
        inner = density[np.abs(x[:, 2]) < 0.3 * LENGTH]
        b = DENSITY * state.sound_speed**2 / 7.0
        pressure = np.maximum(0.0, b * ((inner / DENSITY) ** 7 - 1.0)).mean()
        history.append((*(p.speed for p in tube.pistons), pressure))
    return history, tube.save_state()


def test_blood_between_reservoirs_of_one_pressure_comes_to_rest_under_it(driven, packed):
    history, state = packed
    speeds, pressure = np.array(history)[:, :2], np.array(history)[:, 2]
    jet = math.sqrt(2.0 * 100.0 / DENSITY)
    # It has moved: the lattice leaves room at the wall, which is filled first.
    assert np.abs(speeds).max() > 0.1 * jet
    assert np.abs(speeds[-25:].mean(axis=0)).max() < 0.5 * REST * jet
    assert math.sqrt((speeds[-25:] ** 2).mean()) < REST * jet
    # A plug presses with p on what its columns take up; the blood before it is on all the opening.
    taken = area(driven) / driven.pistons[0].opening.area
    assert 100.0 * (taken - RINGING) < pressure[-25:].mean() < 100.0 * (1.0 + RINGING)
    drive(driven, "top", pressure=100.0)
    drive(driven, "bottom", pressure=100.0)
    driven.load_state(state)
    assert np.linalg.norm(driven.velocities(), axis=1).mean() < REST * jet
    assert driven.diagnostics().leaks == 0


def test_more_pressure_on_one_side_accelerates_the_column_by_dp_over_rho_l(driven, packed):
    # L is the length of all that moves, plugs too, at the plugs' cross-section: the force is
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


def test_a_reservoir_spends_head_on_the_speed_of_what_it_gives(tmp_path):
    # A column of length L between two reservoirs of one pressure: L du/dt = -u^2/2 and friction,
    # which is small in blood as thin as this.  Given the whole pressure at both ends it is driven
    # on: after 0.05 s it had 0.41 m/s, and in a bifurcation ever more.
    sim, speed, time = make_tube(tmp_path, 3.5e-3), 0.5, 0.05
    for name in ENDS:
        drive(sim, name, pressure=400.0)
    sim.advance_to(0.1)
    state = sim.save_state()
    velocity = np.zeros_like(state.velocity)
    velocity[:, 2] = -speed
    for row, piston in zip(state.controls["pistons"], sim.pistons, strict=True):
        row[2] = speed * float(piston.opening.normal[2])
    sim.load_state(replace(state, velocity=velocity))
    length = sim.particles.count[None] * OF_ONE / area(sim)
    sim.advance_to(state.time + time)
    slowed = speed / (1.0 + 0.5 * speed * time / length)
    top, bottom = (piston.speed for piston in sim.pistons)
    assert 0.6 * slowed < 0.5 * (top - bottom) < slowed
    assert sim.diagnostics().leaks == 0


def test_a_vessel_that_is_over_full_is_one_sentence(driven):
    capacity = driven.particles.capacity
    generator = np.random.default_rng(4)
    x = generator.uniform(-0.5, 0.5, (capacity, 3)) * [RADIUS, RADIUS, LENGTH]
    driven.place(x, np.zeros_like(x))
    driven.pistons[0].way = 2.0 * D
    with pytest.raises(RunError) as error:
        driven.step(1.0)
    assert str(error.value) == (
        f"the run diverged: at t = 0 s the vessel is over-full, {capacity} particles; likely "
        "cause: more is driven in than can leave, or the pressure is too high for the sound speed"
    )


def test_an_opening_that_nothing_drives_cannot_be_turned_up(driven):
    with pytest.raises(InputError) as error:
        driven.drive(2.0, "side")
    assert str(error.value) == "inflow: nothing drives side; driven: top, bottom"


@pytest.mark.parametrize("factor", [0.0, 0.5, 2.0])
def test_a_pump_that_is_turned_gets_there_in_the_time_of_rising(driven, factor):
    driven.pistons[0].level = driven.pistons[1].level = 1.0
    driven.drive(factor, "top")
    levels, dt = [], RAMP_TIME / 100.0
    for _ in range(100):
        driven._pistons.advance(driven.particles, 0.0, dt, (0.0, 0.0, 0.0))
        levels.append(driven.pistons[0].level)
    assert levels[-1] == pytest.approx(factor)
    assert np.abs(np.diff(levels)).max() <= dt / RAMP_TIME * (1.0 + 1e-9)
    assert driven.pistons[1].level == 1.0


def test_state_of_a_piston_is_numbers_and_comes_back(driven):
    piston = driven.pistons[0]
    driven.advance_to(0.004)
    kept = msgspec.json.decode(msgspec.json.encode(piston.state()))
    taken, speed, way = piston.taken.copy(), piston.speed, piston.way
    driven.advance_to(0.03)
    assert piston.way > way
    piston.load_state(kept)
    assert (piston.speed, piston.way) == (speed, way)
    np.testing.assert_array_equal(piston.taken, taken)
    assert piston.taken.dtype == np.int64


def test_where_a_scene_lies_does_not_matter(tmp_path: Path) -> None:
    """A waveform's file is sought beside the scene."""
    mesh = make_surface(Tube(name="tube", radius=5.0, length=15.0, segments=24))
    scene = write_scene(tmp_path, mesh, ENDS, 'opening = "top"\nfull = true', D)
    (tmp_path / "beat.csv").write_text("0,1\n1,2\n")
    table = OpeningTable(centre=ENDS["top"], flow=1e-5, waveform="beat.csv")
    scene = msgspec.structs.replace(scene, openings={**scene.openings, "top": table})
    from taichi_sph.geometry.vessel import read_vessel

    (piston,) = make_pistons(scene, read_vessel(scene))
    assert piston.waveform(0.5) == 1.5


def test_a_device_without_sums_of_wide_integers_is_refused(driven, monkeypatch):
    monkeypatch.setattr("taichi_sph.boundary.inflow.has_wide_atomics", lambda: False)
    with pytest.raises(InputError, match=r"^driven openings need .* use --arch cpu$"):
        Simulation(driven.scene, driven.vessel)
