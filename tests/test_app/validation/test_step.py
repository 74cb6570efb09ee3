"""The backward-facing step: its room, its drive, and how its eddy is measured."""

import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from app.validation import step
from app.validation.flows import SLAB, State, state_of

D = step.HEIGHT / 6
SETBACK = 0.92 * D
VOLUME = SLAB * D * step.HEIGHT * (step.NARROW + 2.0 * step.WIDE)


@pytest.fixture(scope="module")
def blood() -> np.ndarray:
    return step.disordered(D)


@pytest.fixture(scope="module")
def proxies() -> tuple[np.ndarray, np.ndarray]:
    return step.walls(D, SETBACK)


def test_clearance_is_positive_in_the_room_alone():
    h, end = step.HEIGHT, step.WIDE
    inside = [(0.5 * h, 0.5 * h), (0.0, 1.5 * h), (-h, 1.4 * h), (end + h, 1.1 * h)]
    outside = [(-0.1 * h, 0.9 * h), (end + 0.1 * h, 0.5 * h), (h, -0.1 * h), (h, 2.1 * h)]
    points = np.array([(x, 0.0, z) for x, z in inside + outside])
    assert (step.clearance(points) > 0.0).tolist() == [True] * 4 + [False] * 4
    assert step.clearance(points)[:2] == pytest.approx([0.5 * h, 0.5 * h])


def test_blood_fills_the_room_out_of_order_and_none_begins_outside(blood):
    assert len(blood) * D**3 == pytest.approx(VOLUME)
    assert step.clearance(blood).min() >= 0.5 * D * (1.0 - 1e-6)
    assert blood[:, 0].min() >= -0.5 * step.NARROW
    assert blood[:, 0].max() < step.WIDE + 0.5 * step.NARROW
    assert blood[:, 1].min() >= 0.0
    assert blood[:, 1].max() < SLAB * D
    # Evenly spread over places between lattice planes: what is left of order is small.
    middle = blood[step.clearance(blood) > 3.0 * D]
    assert abs(np.exp(2j * math.pi * middle[:, 2] / D).mean()) < 0.1


def test_proxies_stand_behind_the_walls_and_look_out_of_the_room(proxies):
    position, normal = proxies
    assert np.linalg.norm(normal, axis=1) == pytest.approx(1.0)
    assert step.clearance(position).max() < -0.8 * SETBACK
    # From a proxy the way back along the normal leads into the room, and to no wall beside it.
    assert step.clearance(position + 0.5 * SETBACK * normal).max() < 0.0
    opposite = position - (SETBACK + 0.5 * D) * normal
    beside = (np.abs(position[:, 0]) < 2.0 * D) | (np.abs(position[:, 0] - step.WIDE) < 2.0 * D)
    assert (step.clearance(opposite)[~beside] > 0.49 * D).all()


def test_no_place_of_a_wall_is_without_a_proxy(proxies):
    x = np.arange(-0.5 * step.NARROW + 2 * D, step.WIDE + 0.5 * step.NARROW - 2 * D, 0.3 * D)
    z = np.arange(0.0, 2.0 * step.HEIGHT, 0.3 * D)
    grid = np.stack(np.meshgrid(x, [4.0 * D], z, indexing="ij"), -1).reshape(-1, 3)
    surface = grid[np.abs(step.clearance(grid)) < 0.05 * D]
    assert len(surface) > 500
    # The farthest from its proxies is the step's edge, a setback away along both axes.
    assert cKDTree(proxies[0]).query(surface)[0].max() < 1.42 * (SETBACK + 0.05 * D)


def test_the_start_is_of_one_flow_rate_and_has_no_divergence():
    speed, e = 0.3, 1e-4 * step.HEIGHT
    z = (np.arange(4000) + 0.5) * 2.0 * step.HEIGHT / 4000
    for x in (-step.HEIGHT, 0.5 * step.SPREAD, 0.5 * step.WIDE, step.WIDE - step.HEIGHT):
        line = np.column_stack([np.full_like(z, x), 0.0 * z, z])
        u = step.start_velocity(line, speed)[:, 0]
        assert u.mean() * 2.0 == pytest.approx(speed, rel=1e-4)
    points = np.random.default_rng(0).uniform(
        [0.0, 0.0, 1.01], [16.0, 0.0, 1.99], (200, 3)
    ) * step.HEIGHT  # fmt: skip
    divergence = np.zeros(200)
    for axis in (0, 2):
        shift = e * np.eye(3)[axis]
        ahead, behind = (step.start_velocity(points + s * shift, speed) for s in (1.0, -1.0))
        divergence += (ahead - behind)[:, axis] / (2.0 * e)
    assert np.abs(divergence).max() < 1e-3 * speed / step.HEIGHT


def made_up(length: float, noise: float) -> State:
    """Blood whose shear rate at the lower wall changes its sign at `length` [m], by a curved
    profile, and a short eddy at the foot of the step that turns the other way.
    """
    generator = np.random.default_rng(1)
    x = generator.uniform([0.0, 0.0, 0.0], [step.WIDE, SLAB * D, 2.0 * step.HEIGHT], (200_000, 3))
    shear = (x[:, 0] - 0.5 * step.HEIGHT) * (x[:, 0] - length) / step.HEIGHT**2
    u = shear * x[:, 2] + 4.0 * x[:, 2] ** 2 / step.HEIGHT
    u += noise * generator.normal(size=len(u))
    return State(x, np.column_stack([u, 0.0 * u, 0.0 * u]), np.ones(len(u)))


@pytest.mark.parametrize("length", [2.93, 4.97])
def test_reattachment_is_where_the_shear_rate_of_a_curved_profile_changes_its_sign(length):
    sums = step.near_wall_sums(made_up(length * step.HEIGHT, 0.1 * step.HEIGHT), D)
    found = step.reattachment(step.places(), step.shear_rate(sums)) / step.HEIGHT
    assert found == pytest.approx(length, abs=0.03)


def test_reattachment_is_the_last_change_and_none_where_flow_stays_backward():
    place = np.arange(6.0)
    assert step.reattachment(place, np.array([1.0, -1, 1, -3, 1, 2])) == pytest.approx(3.75)
    assert math.isnan(step.reattachment(place, np.array([1.0, 1, 1, 1, 1, 1])))
    assert math.isnan(step.reattachment(place, np.array([-1.0, 1, 1, 1, 1, -1])))


def test_the_drive_holds_the_flow_rate_and_blood_stays_in_the_room():
    speed = 0.165
    motion = step.make_step(4, speed, settling=100)
    mean = speed * step.LENGTH / (step.NARROW + 2.0 * step.WIDE)
    motion.advance_to(0.5 * step.HEIGHT / speed)
    state = state_of(motion)
    assert state.velocity[:, 0].mean() == pytest.approx(mean, rel=1e-3)
    assert step.clearance(state.position).min() > 0.0
    # Without it friction would have taken a part.
    motion.boundaries = ()
    motion.advance_to(1.0 * step.HEIGHT / speed)
    assert state_of(motion).velocity[:, 0].mean() < 0.98 * mean
