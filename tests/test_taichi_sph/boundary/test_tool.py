"""The tool: the lists that hold its proxies, how it follows its target, and the force on it."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from builders import CAPACITY, SKIN, D, Prescribed, R, Setup, precision
from reference import separations
from taichi_sph.boundary.tool import LARGEST_SPEED, RESPONSE_TIME, Tool, kept_in_states
from taichi_sph.boundary.tool_surface import ToolSurface
from taichi_sph.fluid.model import AccelerationModel
from tool_stage import AT, BALL, ROUNDING, TURN, hold, proxies

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


def test_the_rows_of_the_tool_are_where_and_how_it_moves(stage, surface):
    v, spin = np.array([0.1, 0.2, -0.1]), np.array([3.0, -20.0, 5.0])
    hold(stage, surface, AT, TURN, tuple(v), tuple(spin))
    arm = surface.position @ TURN.as_matrix().T
    first, close = stage.wall.count, ROUNDING[precision()]
    np.testing.assert_allclose(proxies(stage)[first:], AT + arm, atol=close * BALL)
    expected = surface.normal @ TURN.as_matrix().T
    np.testing.assert_allclose(proxies(stage, "normal")[first:], expected, atol=close)
    expected = np.array([v + np.cross(spin, r) for r in arm])
    np.testing.assert_allclose(proxies(stage, "velocity")[first:], expected, atol=close)
    np.testing.assert_allclose(proxies(stage, "volume")[first:], surface.volume, rtol=close)
    assert not proxies(stage, "velocity")[:first].any()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_lists_hold_the_proxies_of_the_tool_that_brute_force_finds(stage, surface, seed):
    generator = np.random.default_rng(seed)
    stage.put(generator.uniform(-6.0 * D, 6.0 * D, (CAPACITY, 3)))
    for at in generator.uniform(-4.0 * D, 4.0 * D, (3, 3)):
        hold(stage, surface, at, Rotation.random(random_state=generator))
        stage.build()
        distance, found = distances(stage), listed(stage)
        certain = np.abs(distance / (R + SKIN) - 1.0) > ROUNDING[precision()]
        np.testing.assert_array_equal(found[certain], (distance < R + SKIN)[certain])
        assert found[:, stage.wall.count :].any()


class Pushed(Tool):
    """A tool that keeps its velocity."""

    def before_drift(self, dt: float, model: AccelerationModel) -> float:
        moved = self.move(dt)
        self.write_proxies()
        return moved


@pytest.mark.parametrize("still", [True, False], ids=["blood at rest", "blood in motion"])
def test_lists_name_all_within_reach_while_the_tool_moves(stage, surface, still):
    generator = np.random.default_rng(3)
    x = generator.uniform(-4.5 * D, 4.5 * D, (500, 3))
    stage.put(x, (0.0 if still else 0.1) * generator.normal(size=x.shape))
    tool = Pushed(stage.blood(), surface, AT)
    tool.rotation = TURN
    tool.velocity, tool.spin = np.array([0.3, 0.1, -0.1]), np.array([0.0, 10.0, 0.0])
    tool.write_proxies()
    sim = stage.simulation(Prescribed(np.zeros_like, 5e-5), boundaries=(tool,))
    builds, drifted = stage.neighbors.builds, 0.0
    since = before = proxies(stage)
    for _ in range(80):
        built = stage.neighbors.builds
        sim.step(1.0)
        if stage.neighbors.builds > built:
            since = before
        before = proxies(stage)
        if not stage.neighbors.stale:
            near = distances(stage) < R * (1.0 - ROUNDING[precision()])
            assert listed(stage)[near].all()
            assert near[:, stage.wall.count :].any()
            drifted = max(drifted, float(np.linalg.norm(before - since, axis=1).max()))
    # Several lists were used, and each for long: the rule was put to the test.
    assert 3 < stage.neighbors.builds - builds < 30
    assert drifted > 0.3 * SKIN


# The hand


def follow(
    tool: Tool, surface: ToolSurface, dt: float, steps: int
) -> list[tuple[np.ndarray, float]]:
    """Where the proxies are, step by step, and how far each step may go."""
    path = []
    for _ in range(steps):
        tool.update_velocity()
        way = tool.move(dt)
        path.append((tool.position + tool.rotation.apply(surface.position), way))
    return path


@pytest.mark.parametrize("dt", [3e-5, 3e-4, 9e-3])
def test_a_tool_comes_to_where_it_is_wanted_and_stays(stage, surface, dt):
    tool = Tool(stage.blood(), surface, np.zeros(3))
    tool.target_position = np.array([0.01, -0.02, 0.03])
    tool.target_rotation = Rotation.from_rotvec([0.5, 2.0, -0.7])
    # At half of LARGEST_SPEED for the way, a little for the turn, then e-folds of RESPONSE_TIME.
    time = 0.04 / (0.5 * LARGEST_SPEED) + 20.0 * RESPONSE_TIME
    before = math.inf
    for _ in range(round(time / dt)):
        tool.update_velocity()
        tool.move(dt)
        away = float(np.linalg.norm(tool.target_position - tool.position))
        assert away <= before * (1.0 + 1e-12)
        before = away
    assert np.linalg.norm(tool.target_position - tool.position) < 1e-6
    assert (tool.target_rotation * tool.rotation.inv()).magnitude() * surface.radius < 1e-6
    tool.update_velocity()
    assert tool.at_rest
    assert tool.move(dt) == 0.0


def test_no_proxy_goes_faster_than_a_hand_and_none_farther_than_is_told(stage, surface):
    tool = Tool(stage.blood(), surface, np.zeros(3))
    dt, fastest = 1e-4, 0.0
    generator = np.random.default_rng(4)
    before = tool.position + tool.rotation.apply(surface.position)
    for _ in range(20):
        tool.target_position = generator.uniform(-0.1, 0.1, 3)
        tool.target_rotation = Rotation.random(random_state=generator)
        for points, way in follow(tool, surface, dt, 20):
            gone = np.linalg.norm(points - before, axis=1).max()
            assert gone <= way * (1.0 + 1e-9)
            fastest, before = max(fastest, gone / dt), points
    assert 0.5 * LARGEST_SPEED < fastest <= LARGEST_SPEED * (1.0 + 1e-9)


def test_a_near_goal_is_neared_by_an_e_fold_in_the_time_of_following(stage, surface):
    tool = Tool(stage.blood(), surface, np.zeros(3))
    tool.target_position = np.array([1e-3, 0.0, 0.0])
    follow(tool, surface, 1e-4, round(RESPONSE_TIME / 1e-4))
    # (1 - dt/T)^(T/dt) for 1/e.
    assert tool.position[0] == pytest.approx(1e-3 * (1.0 - np.exp(-1.0)), rel=0.01)


def test_velocity_and_spin_are_the_motion_of_the_proxies(stage, surface):
    tool = hold(stage, surface)
    tool.target_position = AT + [0.0, 0.01, 0.0]
    tool.target_rotation = Rotation.from_rotvec([0.0, 0.3, 0.0]) * TURN
    tool.update_velocity()
    tool.write_proxies()
    before, velocity = proxies(stage), proxies(stage, "velocity")
    dt = 1e-5
    tool.move(dt)
    tool.write_proxies()
    found = ((proxies(stage) - before) / dt)[stage.wall.count :]
    # A turn by w dt bends the way by w dt/2; positions of f32 are known to 1e-7 of 10 mm.
    limit = {"f64": 1e-3, "f32": 0.5}[precision()] * np.abs(velocity).max()
    np.testing.assert_allclose(found, velocity[stage.wall.count :], rtol=0, atol=limit)


def test_a_tool_without_a_surface_is_at_once_at_its_target(stage):
    tool = Tool(stage.blood(), None, np.array([1.0, 2.0, 3.0]))
    assert not tool.arrived
    tool.target_position = np.array([1.0, 2.003, 3.004])
    assert tool.teleport() == pytest.approx(0.005)
    assert tool.position.tolist() == [1.0, 2.003, 3.004]
    assert tool.arrived
    tool.reset()
    assert tool.position.tolist() == [1.0, 2.0, 3.0]
    assert not tool.arrived
    assert tool.teleport() == 0.0


def test_a_turned_tool_comes_back_from_its_quaternion_bit_by_bit():
    generator = np.random.default_rng(0)
    turns = [Rotation.from_rotvec(1e-3 * generator.normal(size=3)) for _ in range(2000)]

    def read_back(rotation: Rotation) -> bool:
        saved = rotation.as_quat().tolist()
        return Rotation.from_quat(np.array(saved)).as_quat().tolist() == saved

    plain = kept = Rotation.identity()
    survived = []
    for turn in turns:
        plain, kept = turn * plain, kept_in_states(turn * kept)
        survived.append(read_back(plain))
        assert read_back(kept)
    assert not all(survived)  # the length of a product is 1 but for its last digit
    assert (plain * kept.inv()).magnitude() < 1e-12
