"""The tool: its proxies, the lists that hold them, what blood feels of their motion, its hand."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from taichi import ndarray

from builders import (
    CAPACITY,
    KERNEL,
    SKIN,
    SPHERE,
    WALL_SPACING,
    D,
    Prescribed,
    R,
    Setup,
    ball,
    calibration,
    float_dtype,
    make_fluid,
    make_model,
    precision,
    sphere,
)
from nn.features import GATHERED, FeatureScales, extract
from reference import Blood, proxy_volumes, separations
from taichi_sph.boundary.tool import FOLLOWING, LARGEST_SPEED, Shape, Tool, read_shape
from taichi_sph.errors import InputError
from taichi_sph.fluid.implicit import ImplicitAcceleration
from taichi_sph.fluid.rheology import Casson
from taichi_sph.fluid.wcsph import force_on_tool, sum_acceleration
from taichi_sph.motion import Motion
from taichi_sph.particles.neighbors import Neighbors, make_grid
from taichi_sph.particles.wall import Wall
from taichi_sph.scene import ToolTable

SUMS = {"f64": 1e-11, "f32": 2e-4}
"""Of the largest value: sums of some 40 terms; in f32 (rho/rho_0)^7 multiplies 1e-6 by seven."""
SERIES = 1e-7
"""The law's exponential is a series of three terms near rest (see test_rheology)."""
FRAME = {"f64": 1e-9, "f32": 5e-3}
"""Of the largest value: adding 10 m/s to 0.1 m/s costs two to three digits."""
ROUNDING = {"f64": 1e-12, "f32": 1e-5}
"""Pairs this near to the radius, relatively, may be told either way."""
FACET = 0.02
"""Of the radius: triangles of a sphere of 642 corners lie below it by a hundredth."""

BALL = 2.0 * D
"""Radius of the tool, a ball whose lowest point is its origin [m]."""
AT = np.array([0.6, -0.5, -1.7]) * D
TURN = Rotation.from_rotvec([0.5, -0.8, 0.3])
TRAIN = np.array([10.0, -3.0, 5.0])
"""Velocity of a moving train [m/s]."""

BLOOD = make_fluid(background=300.0, rheology=Casson(3.5e-3, 5e-3, 7.0), alpha=0.05)
NESTED = replace(BLOOD, nested=True)
THIN = make_fluid(rheology=Casson(3.5e-3, 5e-3, 7.0), alpha=0.05)
SCALES = FeatureScales(R, D, 4e-4, 2.0, WALL_SPACING / D)


def globe() -> trimesh.Trimesh:
    """The ball's surface [m], its origin the lowest point."""
    surface = trimesh.creation.icosphere(subdivisions=3, radius=BALL)
    surface.apply_translation([0.0, 0.0, BALL])
    return surface


def shape_of(folder: Path, surface: trimesh.Trimesh, scale: float = 1.0) -> Shape:
    surface.export(folder / "tool.ply")
    table = ToolTable(surface="tool.ply", position=(0.0, 0.0, 0.0), scale=scale)
    return read_shape(table, folder, WALL_SPACING, calibration().setback, KERNEL)


@pytest.fixture(scope="module")
def shape(tmp_path_factory: pytest.TempPathFactory) -> Shape:
    return shape_of(tmp_path_factory.mktemp("tool"), globe())


@cache
def _stage(count: int) -> Setup:
    """The round vessel once more, with room for the proxies of a tool."""
    vessel, edge = sphere(), 9.1 * D
    y, n = vessel.wall_position, vessel.wall_normal
    wall = Wall.from_numpy(y, n, KERNEL, calibration().setback, WALL_SPACING, tool=count)
    grid = make_grid(np.full(3, -edge), np.full(3, edge), R + SKIN)
    neighbors = Neighbors.allocate(grid, R, SKIN, CAPACITY, D, wall)
    neighbors.sort_wall(wall)
    return Setup(vessel.particles, wall, neighbors, y, n)


@pytest.fixture
def stage(shape: Shape) -> Setup:
    """Blood round the ball in the round vessel, the ball in the middle and at rest."""
    stage = _stage(len(shape.position))
    stage.wall.velocity.fill(0.0)
    hold(stage, shape)
    generator = np.random.default_rng(0)
    x = ball(generator, SPHERE - 0.2 * D)
    x = x[np.linalg.norm(x - middle(AT), axis=1) > BALL + 0.2 * D]
    stage.put(x, np.roll(50.0 * x, 1, axis=1) + 0.03 * generator.normal(size=x.shape))
    return stage


def middle(at: np.ndarray, turn: Rotation = TURN) -> np.ndarray:
    """Centre of the ball at a place [m], (3,)."""
    return at + turn.apply([0.0, 0.0, BALL])


def hold(stage: Setup, shape: Shape, at: np.ndarray = AT, turn: Rotation = TURN,
         velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
         spin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Tool:  # fmt: skip
    """Put the tool somewhere, in motion."""
    tool = Tool(shape, at)
    tool.rotation = turn
    tool.velocity, tool.spin = np.array(velocity), np.array(spin)
    tool.place(stage.wall, stage.neighbors)
    return tool


def proxies(stage: Setup, field: str = "position") -> np.ndarray:
    """Rows of the wall, those of the tool last."""
    return getattr(stage.wall, field).to_numpy().astype(float)


# The shape


def test_proxies_stand_a_setback_inside_the_surface_and_evenly(shape):
    centre = np.array([0.0, 0.0, BALL])
    r = np.linalg.norm(shape.position - centre, axis=1)
    np.testing.assert_allclose(r, BALL - calibration().setback, atol=FACET * BALL)
    outward = (shape.position - centre) / r[:, None]
    np.testing.assert_allclose(-shape.normal, outward, atol=0.1)
    np.testing.assert_allclose(np.linalg.norm(shape.normal, axis=1), 1.0, rtol=1e-12)
    assert len(r) == pytest.approx(4.0 * np.pi * BALL**2 / WALL_SPACING**2, rel=0.03)
    feet = shape.position - calibration().setback * shape.normal
    apart = np.linalg.norm(separations(feet, feet), axis=-1)
    np.fill_diagonal(apart, np.inf)
    # Even points: no two nearer than half of the mean spacing.
    assert apart.min() > 0.5 * WALL_SPACING
    assert np.linalg.norm(shape.position, axis=1).max() == pytest.approx(shape.radius)


def test_volumes_of_the_proxies_are_equation_3(shape):
    np.testing.assert_allclose(shape.volume, proxy_volumes(shape.position, R), rtol=1e-12)


def test_a_shape_knows_what_is_clear_of_it_and_how_far(shape):
    points = np.random.default_rng(1).uniform(-2.0 * BALL, 3.0 * BALL, (500, 3))
    away = np.linalg.norm(points - [0.0, 0.0, BALL], axis=1) - BALL
    certain = np.abs(away) > FACET * BALL
    np.testing.assert_array_equal(shape.clear_of(points)[certain], away[certain] > 0.0)
    np.testing.assert_allclose(shape.distance(points), np.abs(away), atol=FACET * BALL)


def test_a_scale_makes_metres_of_the_file(tmp_path, shape):
    large = globe()
    large.apply_scale(1e3)
    found = shape_of(tmp_path, large, 1e-3)
    # The file holds single precision.
    np.testing.assert_allclose(found.radius, shape.radius, rtol=1e-5)
    assert len(found.position) == len(shape.position)


def test_no_proxy_of_a_thin_tool_stands_outside_it(tmp_path):
    # A needle of 0.6 mm in blood of 1 mm: the setback is three times its radius.
    needle = trimesh.creation.cylinder(radius=0.3 * D, height=12.0 * D, sections=24)
    try:
        found = shape_of(tmp_path, needle)
    except InputError:
        return  # refused is as good
    away = np.where(found.clear_of(found.position), found.distance(found.position), 0.0)
    assert away.max() < FACET * D


def pierced() -> trimesh.Trimesh:
    surface = globe()
    surface.update_faces(np.arange(len(surface.faces)) > 0)
    return surface


def inside_out() -> trimesh.Trimesh:
    surface = globe()
    surface.invert()
    return surface


def in_two() -> trimesh.Trimesh:
    other = globe()
    other.apply_translation([3.0 * BALL, 0.0, 0.0])
    return trimesh.util.concatenate([globe(), other])


@pytest.mark.parametrize("mistake", [pierced, inside_out, in_two])
def test_a_surface_with_a_hole_or_inside_out_or_in_two_is_one_sentence(tmp_path, mistake):
    with pytest.raises(InputError) as error:
        shape_of(tmp_path, mistake())
    assert str(error.value).startswith(f"{tmp_path / 'tool.ply'}: ")
    assert "\n" not in str(error.value)


def test_a_surface_that_is_not_there_is_one_sentence(tmp_path):
    table = ToolTable(surface="none.stl", position=(0.0, 0.0, 0.0))
    with pytest.raises(InputError) as error:
        read_shape(table, tmp_path, WALL_SPACING, calibration().setback, KERNEL)
    expected = f"{tmp_path / 'none.stl'}: cannot read the surface: No such file or directory"
    assert str(error.value) == expected


# Lists


def listed(stage: Setup) -> np.ndarray:
    """Which proxies are on the list of each row, (n, m); one listed twice is refused."""
    n, nb = stage.particles.count[None], stage.neighbors
    counts, index = nb.wall_count.to_numpy()[:n], nb.wall_index.to_numpy()[:n]
    table = np.zeros((n, stage.wall.count + stage.wall.tool), int)
    row, slot = np.nonzero(np.arange(index.shape[1]) < counts[:, None])
    np.add.at(table, (row, index[row, slot]), 1)
    assert table.max(initial=0) <= 1
    return table.astype(bool)


def distances(stage: Setup) -> np.ndarray:
    """From rows to proxies [m], (n, m)."""
    x = stage.particles.position.to_numpy()[: stage.particles.count[None]].astype(float)
    return np.linalg.norm(separations(x, proxies(stage)), axis=-1)


def test_the_rows_of_the_tool_are_where_and_how_it_moves(stage, shape):
    v, spin = np.array([0.1, 0.2, -0.1]), np.array([3.0, -20.0, 5.0])
    hold(stage, shape, AT, TURN, tuple(v), tuple(spin))
    arm = shape.position @ TURN.as_matrix().T
    first, close = stage.wall.count, ROUNDING[precision()]
    np.testing.assert_allclose(proxies(stage)[first:], AT + arm, atol=close * BALL)
    expected = shape.normal @ TURN.as_matrix().T
    np.testing.assert_allclose(proxies(stage, "normal")[first:], expected, atol=close)
    expected = np.array([v + np.cross(spin, r) for r in arm])
    np.testing.assert_allclose(proxies(stage, "velocity")[first:], expected, atol=close)
    np.testing.assert_allclose(proxies(stage, "volume")[first:], shape.volume, rtol=close)
    assert not proxies(stage, "velocity")[:first].any()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_lists_hold_the_proxies_of_the_tool_that_brute_force_finds(stage, shape, seed):
    generator = np.random.default_rng(seed)
    stage.put(generator.uniform(-6.0 * D, 6.0 * D, (CAPACITY, 3)))
    for at in generator.uniform(-4.0 * D, 4.0 * D, (3, 3)):
        hold(stage, shape, at, Rotation.random(random_state=generator))
        stage.build()
        distance, found = distances(stage), listed(stage)
        certain = np.abs(distance / (R + SKIN) - 1.0) > ROUNDING[precision()]
        np.testing.assert_array_equal(found[certain], (distance < R + SKIN)[certain])
        assert found[:, stage.wall.count :].any()


class Handled(Motion):
    """A motion in which a hand moves the tool."""

    tool: Tool

    def before_drift(self, dt: float) -> None:
        self._wall_moved += self.tool.move(dt)
        self.tool.place(self.wall, self.neighbors)


@pytest.mark.parametrize("still", [True, False], ids=["blood at rest", "blood in motion"])
def test_lists_name_all_within_reach_while_the_tool_moves(stage, shape, still):
    generator = np.random.default_rng(3)
    x = generator.uniform(-4.5 * D, 4.5 * D, (500, 3))
    stage.put(x, (0.0 if still else 0.1) * generator.normal(size=x.shape))
    motion = Handled(stage.particles, stage.wall, stage.neighbors,
                     Prescribed(np.zeros_like, 5e-5), (0.0, 0.0, 0.0), 1e9)  # fmt: skip
    motion.tool = hold(stage, shape, AT, TURN, (0.3, 0.1, -0.1), (0.0, 10.0, 0.0))
    builds, drifted = stage.neighbors.builds, 0.0
    since = before = proxies(stage)
    for _ in range(80):
        built = stage.neighbors.builds
        motion.step(1.0)
        if stage.neighbors.builds > built:
            since = before
        before = proxies(stage)
        if not motion._stale:
            near = distances(stage) < R * (1.0 - ROUNDING[precision()])
            assert listed(stage)[near].all()
            assert near[:, stage.wall.count :].any()
            drifted = max(drifted, float(np.linalg.norm(before - since, axis=1).max()))
    # Several lists were used, and each for long: the rule was put to the test.
    assert 3 < stage.neighbors.builds - builds < 30
    assert drifted > 0.3 * SKIN


# Forces


class Moving(Blood):
    """The sums by brute force where proxies have volumes and velocities of their own."""

    v_k: np.ndarray

    def move(self, volume: np.ndarray, v_k: np.ndarray) -> "Moving":
        self.volume, self.v_k = volume, v_k
        self.rho = self.density()
        self.p = self.pressure(self.rho)
        return self

    @property
    def v_ik(self) -> np.ndarray:
        return self.v[:, None] - self.v_k[None]

    def velocity_gradient(self, weights):
        blood = np.einsum("ija,ijb,j->iab", -self.v_ij, self.grad, weights)
        wall = np.einsum("ika,ikb,k->iab", -self.v_ik, self.grad_wall, self.volume)
        return self.factors["gradient"] * (blood + self.factors["wall_gradient"] * wall)

    def wall_artificial_acceleration(self):
        return self.of_proxies("artificial").sum(axis=1)

    def wall_friction_acceleration(self, nested=False):
        return self.of_proxies("friction", nested).sum(axis=1)

    def of_proxies(self, term: str, nested: bool = False) -> np.ndarray:
        """What each proxy does to each particle [m/s^2], (n, m, 3)."""
        r2 = (self.r_wall**2).sum(-1) + self.eps
        rho = self.rho[:, None]
        psi = self.rest_density * self.volume[None]
        if term == "friction":
            mu = self.viscosity(nested)[:, None]
            rg = (self.r_wall * self.grad_wall).sum(-1)
            factor = 2.0 * self.factors["wall_friction"] * psi * mu / rho**2 * rg / r2
            return factor[..., None] * self.v_ik
        psi = psi * self.factors["wall_density"]
        if term == "pressure":
            push = self.factors["gradient"] * (self.p / self.rho**2)[:, None]
        else:
            approach = np.minimum(0.0, (self.v_ik * self.r_wall).sum(-1))
            push = -self.alpha * self.sound_speed * (self.support / 2.0) * approach / r2 / rho
        return -(psi * push)[..., None] * self.grad_wall


def brute_force(stage: Setup, fluid) -> Moving:
    """The state in the fields, proxies of wall and tool alike."""
    known = vars(stage.reference(fluid))
    arguments = {name: known[name] for name in Blood.__dataclass_fields__}
    moving = Moving(**{**arguments, "y": proxies(stage)})
    return moving.move(proxies(stage, "volume"), proxies(stage, "velocity"))


def assert_close(found: np.ndarray, expected: np.ndarray, relative: float) -> None:
    scale = np.abs(expected).max()
    assert scale > 0.0
    np.testing.assert_allclose(found, expected, rtol=0, atol=relative * scale)


MOTION = ((0.2, -0.1, 0.15), (30.0, -50.0, 20.0))


@pytest.mark.parametrize("fluid", [BLOOD, NESTED], ids=["pairwise", "nested"])
def test_what_a_tool_that_moves_and_turns_does_to_blood_is_brute_force(stage, shape, fluid):
    hold(stage, shape, AT, TURN, *MOTION)
    found = stage.accelerate(fluid, (1.0, -2.0, -9.81))
    moving = brute_force(stage, fluid)
    assert_close(stage.in_order(make_model(fluid).viscosity), moving.viscosity(fluid.nested),
                 SUMS[precision()] + SERIES)  # fmt: skip
    expected = moving.acceleration(np.array([1.0, -2.0, -9.81]), nested=fluid.nested)
    assert_close(found, expected, SUMS[precision()] + SERIES)
    # The motion is large enough to be missed.
    still = moving.move(moving.volume, 0.0 * moving.v_k)
    change = still.acceleration(np.array([1.0, -2.0, -9.81]), nested=fluid.nested) - expected
    assert np.abs(change).max() > 0.01 * np.abs(expected).max()


def in_the_train(stage: Setup) -> None:
    """Let blood, wall and tool move along."""
    v = stage.particles.velocity.to_numpy()
    stage.particles.velocity.from_numpy((v + TRAIN).astype(float_dtype()))
    velocity = proxies(stage, "velocity") + TRAIN
    stage.wall.velocity.from_numpy(velocity.astype(float_dtype()))


@pytest.mark.parametrize("fluid", [BLOOD, NESTED], ids=["pairwise", "nested"])
def test_blood_vessel_and_tool_in_a_moving_train_accelerate_alike(stage, shape, fluid):
    hold(stage, shape, AT, TURN, *MOTION)
    at_rest = stage.accelerate(fluid)
    in_the_train(stage)
    assert_close(stage.accelerate(fluid), at_rest, FRAME[precision()])


def test_the_implicit_pressure_in_a_moving_train_is_the_same(stage, shape):
    hold(stage, shape, AT, TURN, *MOTION)
    model = ImplicitAcceleration(THIN, CAPACITY, 2e-4, rounds=2)
    found = []
    for _ in range(2):
        stage.build()
        model.accelerate(stage.particles, stage.wall, stage.neighbors, (0.0, 0.0, 0.0))
        found.append([stage.in_order(f) for f in (
            stage.particles.acceleration, model.physics.pressure_term, model.physics.viscosity
        )])  # fmt: skip
        in_the_train(stage)
    for at_rest, moving in zip(*found, strict=True):
        assert_close(moving, at_rest, FRAME[precision()])


def test_features_in_a_moving_train_are_the_same(stage, shape):
    hold(stage, shape, AT, TURN, *MOTION)
    found = []
    for _ in range(2):
        stage.build()
        out = ndarray(float, (CAPACITY, GATHERED))
        extract(stage.particles, stage.wall, stage.neighbors, THIN, SCALES, out)
        found.append(out.to_numpy()[: stage.particles.count[None]])
        in_the_train(stage)
    # Skewness and kurtosis of speeds jump where rounding moves a speed to the next bin.
    smooth = [k for k in range(GATHERED) if k not in (13, 15)]
    for k in smooth[3:]:
        assert_close(found[1][:, k], found[0][:, k], FRAME[precision()])


def test_divergence_feels_the_tool_come(stage, shape):
    """d(rho)/dt by brute force, proxies' own motion in it."""
    hold(stage, shape, AT, TURN, *MOTION)
    stage.build()
    out = ndarray(float, (CAPACITY, GATHERED))
    extract(stage.particles, stage.wall, stage.neighbors, THIN, SCALES, out)
    found = out.to_numpy()[: stage.particles.count[None], 24] / -SCALES.frame_interval
    moving = brute_force(stage, THIN)
    rate = moving.spacing_volume * np.einsum("ija,ija->i", moving.grad, moving.v_ij)
    rate += THIN.calibration.wall_density * np.einsum(
        "ika,ika,k->i", moving.grad_wall, moving.v_ik, moving.volume
    )
    assert_close(found, rate, SUMS[precision()])


def force(stage: Setup, fluid) -> np.ndarray:
    """Of the blood on the tool, right after `accelerate` [N], (3,)."""
    found = force_on_tool(
        stage.particles, stage.wall, stage.neighbors, *make_model(fluid).pair_coefficients
    )
    return np.array([found[a] for a in range(3)])


def test_the_force_on_the_tool_is_minus_what_its_proxies_do_to_blood(stage, shape):
    hold(stage, shape, AT, TURN, *MOTION)
    stage.accelerate(BLOOD)
    moving = brute_force(stage, BLOOD)
    parts = [moving.of_proxies(term) for term in ("pressure", "artificial", "friction")]
    of_tool = np.sum(parts, axis=0)[:, stage.wall.count :]
    expected = -calibration().mass * of_tool.sum(axis=(0, 1))
    magnitude = calibration().mass * np.linalg.norm(of_tool, axis=-1).sum()
    np.testing.assert_allclose(force(stage, BLOOD), expected, rtol=0,
                               atol=(SUMS[precision()] + SERIES) * magnitude)  # fmt: skip
    assert np.linalg.norm(expected) > 0.01 * magnitude


def test_what_the_tool_takes_from_blood_is_momentum_of_the_blood_that_particles_stand_for(
    stage, shape
):
    hold(stage, shape, AT, TURN, *MOTION)
    with_tool = stage.accelerate(BLOOD)
    found = force(stage, BLOOD)
    # The same forces once more, the tool's proxies struck from the lists.
    nb, model = stage.neighbors, make_model(BLOOD)
    counts, index = nb.wall_count.to_numpy(), nb.wall_index.to_numpy()
    for row in range(stage.particles.count[None]):
        kept = index[row, : counts[row]]
        kept = kept[kept < stage.wall.count]
        counts[row] = len(kept)
        index[row, : len(kept)] = kept
    nb.wall_count.from_numpy(counts)
    nb.wall_index.from_numpy(index)
    sum_acceleration(stage.particles, stage.wall, nb, BLOOD, model.pressure_term, model.viscosity,
                     model.stress, 0.0, 0.0, 0.0)  # fmt: skip
    taken = (with_tool - stage.in_order(stage.particles.acceleration)).sum(axis=0)
    # What a particle stands for is `Particles.mass`: so much blood rests on a tool at rest.
    mass = stage.particles.mass
    limit = SUMS[precision()] * mass * np.abs(with_tool).sum()
    np.testing.assert_allclose(found, -mass * taken, rtol=1e-6, atol=limit)


# The hand


def follow(tool: Tool, shape: Shape, dt: float, steps: int) -> list[tuple[np.ndarray, float]]:
    """Where the proxies are, step by step, and how far each step may go."""
    path = []
    for _ in range(steps):
        tool.aim()
        way = tool.move(dt)
        path.append((tool.position + tool.rotation.apply(shape.position), way))
    return path


@pytest.mark.parametrize("dt", [3e-5, 3e-4, 9e-3])
def test_a_tool_comes_to_where_it_is_wanted_and_stays(shape, dt):
    tool = Tool(shape, np.zeros(3))
    tool.wanted_position = np.array([0.01, -0.02, 0.03])
    tool.wanted_rotation = Rotation.from_rotvec([0.5, 2.0, -0.7])
    # At half of LARGEST_SPEED for the way, a little for the turn, then e-folds of FOLLOWING.
    time = 0.04 / (0.5 * LARGEST_SPEED) + 20.0 * FOLLOWING
    before = math.inf
    for _ in range(round(time / dt)):
        tool.aim()
        tool.move(dt)
        away = float(np.linalg.norm(tool.wanted_position - tool.position))
        assert away <= before * (1.0 + 1e-12)
        before = away
    assert np.linalg.norm(tool.wanted_position - tool.position) < 1e-6
    assert (tool.wanted_rotation * tool.rotation.inv()).magnitude() * shape.radius < 1e-6
    tool.aim()
    assert tool.at_rest
    assert tool.move(dt) == 0.0


def test_no_proxy_goes_faster_than_a_hand_and_none_farther_than_is_told(shape):
    tool = Tool(shape, np.zeros(3))
    dt, fastest = 1e-4, 0.0
    generator = np.random.default_rng(4)
    before = tool.position + tool.rotation.apply(shape.position)
    for _ in range(20):
        tool.wanted_position = generator.uniform(-0.1, 0.1, 3)
        tool.wanted_rotation = Rotation.random(random_state=generator)
        for points, way in follow(tool, shape, dt, 20):
            gone = np.linalg.norm(points - before, axis=1).max()
            assert gone <= way * (1.0 + 1e-9)
            fastest, before = max(fastest, gone / dt), points
    assert 0.5 * LARGEST_SPEED < fastest <= LARGEST_SPEED * (1.0 + 1e-9)


def test_a_near_goal_is_neared_by_an_e_fold_in_the_time_of_following(shape):
    tool = Tool(shape, np.zeros(3))
    tool.wanted_position = np.array([1e-3, 0.0, 0.0])
    follow(tool, shape, 1e-4, round(FOLLOWING / 1e-4))
    # (1 - dt/T)^(T/dt) for 1/e.
    assert tool.position[0] == pytest.approx(1e-3 * (1.0 - np.exp(-1.0)), rel=0.01)


def test_velocity_and_spin_are_the_motion_of_the_proxies(stage, shape):
    tool = hold(stage, shape)
    tool.wanted_position = AT + [0.0, 0.01, 0.0]
    tool.wanted_rotation = Rotation.from_rotvec([0.0, 0.3, 0.0]) * TURN
    tool.aim()
    tool.place(stage.wall, stage.neighbors)
    before, velocity = proxies(stage), proxies(stage, "velocity")
    dt = 1e-5
    tool.move(dt)
    tool.place(stage.wall, stage.neighbors)
    found = ((proxies(stage) - before) / dt)[stage.wall.count :]
    # A turn by w dt bends the way by w dt/2; positions of f32 are known to 1e-7 of 10 mm.
    limit = {"f64": 1e-3, "f32": 0.5}[precision()] * np.abs(velocity).max()
    np.testing.assert_allclose(found, velocity[stage.wall.count :], rtol=0, atol=limit)


def test_a_tool_without_a_shape_is_at_once_where_it_is_wanted():
    tool = Tool(None, np.array([1.0, 2.0, 3.0]))
    assert tool.count == 0
    assert not tool.settled
    tool.wanted_position = np.array([1.0, 2.003, 3.004])
    assert tool.jump() == pytest.approx(0.005)
    assert tool.position.tolist() == [1.0, 2.003, 3.004]
    assert tool.settled
    tool.start_again()
    assert tool.position.tolist() == [1.0, 2.0, 3.0]
    assert not tool.settled
    assert tool.jump() == 0.0
