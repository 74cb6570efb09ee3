"""Outlets against brute force: what has left by which, the counts, suction, droplets that fall."""

from functools import cache

import numpy as np
import pytest

from builders import CAPACITY, D, Setup, float_dtype, precision, sphere
from taichi_sph.boundary.outlets import (
    DROPLET_TIME,
    MOST_DROPLETS,
    OUT_OF_BOX,
    SUCTION,
    Outlets,
)
from taichi_sph.boundary.suction import aspirate

ROUNDING = {"f64": 1e-12, "f32": 1e-6}
"""Positions and sums of two or three terms, over the box or the largest term."""
DOUBT = {"f64": 1e-12, "f32": 1e-5}
"""Points this near to a surface, over a spacing, may be told either way."""
GRAVITY = (0.3, -0.2, -9.81)

# Of the round vessel's four exits: ends of the line [D], normal, reach [D].
ROUND = ((4.0, 0.0, 0.0), (4.0, 0.0, 0.0), (1.0, 0.0, 0.0), 6.0)
CUT = ((-3.0, 6.0, -2.0), (2.0, 6.0, 2.5), (0.0, 0.8, 0.6), 5.0)
BESIDE = ((5.0, 1.0, 0.0), (5.0, 1.0, 0.0), (0.6, 0.8, 0.0), 7.0)


@cache
def outlets() -> Outlets:
    return Outlets(sphere().blood(GRAVITY), 4)


def clear() -> Outlets:
    """The exits as they were made: all shut, nothing has left."""
    e = outlets()
    e.reach.fill(0.0)
    e.removed.fill(0)
    e.droplet_count[None] = 0
    e.blood.time = 0.0
    return e


def opened(k: int, exit_: tuple, track_droplets: bool = False) -> None:
    begin, end, normal, reach = exit_
    outlets().open(
        k, D * np.array(begin), D * np.array(end), np.array(normal), D * reach, track_droplets
    )


def cloud(seed: int, count: int = CAPACITY) -> tuple[np.ndarray, np.ndarray]:
    """Points all over the round vessel's box and a little beyond it, and velocities."""
    generator = np.random.default_rng(seed)
    x = generator.uniform(-10.5 * D, 11.0 * D, (count, 3)).astype(float_dtype()).astype(float)
    return x, generator.normal(size=x.shape).astype(float_dtype()).astype(float)


def corners(stage: Setup) -> tuple[np.ndarray, np.ndarray]:
    grid = stage.neighbors.grid
    lower = np.array(grid.lower)
    return lower, lower + np.array(grid.cell) * np.array(grid.shape)


def beyond(x: np.ndarray, exit_: tuple) -> tuple[np.ndarray, np.ndarray]:
    """Which points have left by an exit, and how near each is to being told otherwise [D]."""
    begin, end, normal = (np.array(v) for v in exit_[:3])
    # Nearest of many points on the line, then of many about that: no formula of the foot.
    r, place = x / D - begin, np.zeros(len(x))
    for half in (0.5, 1e-2, 2e-4, 4e-6, 1e-7):
        tried = np.clip(place[:, None] + half * np.linspace(-1.0, 1.0, 201) + 0.5 * (half == 0.5),
                        0.0, 1.0)  # fmt: skip
        away = np.linalg.norm(r[:, None] - tried[..., None] * (end - begin), axis=2)
        best = away.argmin(axis=1)
        place = tried[np.arange(len(x)), best]
    distance, height = away.min(axis=1), r @ normal
    left = (height > 0.0) & (distance < exit_[3])
    return left, np.minimum(np.abs(height), np.abs(distance - exit_[3]))


def names(stage: Setup) -> np.ndarray:
    return stage.particles.identity.to_numpy()[: stage.particles.count[None]]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_what_has_left_and_by_which_exit_is_what_brute_force_says(seed):
    stage, e = sphere(), clear()
    # Exit 1 is shut; 3 overlaps 0, which is asked first.
    opened(0, ROUND)
    opened(2, CUT)
    opened(3, BESIDE)
    x, v = cloud(seed)
    stage.put(x, v)
    e.mark_outflow()
    lower, upper = corners(stage)
    outside = ((x < lower) | (x > upper)).any(axis=1)
    doubt = np.abs(np.stack([x - lower, x - upper])).min(axis=(0, 2)) / D
    expected = np.where(outside, -2 - OUT_OF_BOX, np.arange(len(x)))
    for k, each in ((3, BESIDE), (2, CUT), (0, ROUND)):
        left, near = beyond(x, each)
        expected[left] = -4 - k
        doubt = np.minimum(doubt, near)
    certain = doubt > DOUBT[precision()]
    assert certain.mean() > 0.99
    found = names(stage)
    np.testing.assert_array_equal(found[certain], expected[certain])
    # Every kind is there, and what two exits claim too.
    assert {-2, -4, -6, -7} <= set(found.tolist())
    assert (beyond(x, ROUND)[0] & beyond(x, BESIDE)[0]).any()
    assert (beyond(x, CUT)[0] & outside).any()
    places = {OUT_OF_BOX: -2, SUCTION: -3} | {2 + k: -4 - k for k in range(4)}
    counted = [int((found == name).sum()) for _, name in sorted(places.items())]
    np.testing.assert_array_equal(e.outflow_counts(), counted)
    assert e.outflow_counts()[[SUCTION, 3]].tolist() == [0, 0]


def test_marking_again_counts_nobody_twice():
    stage, e = sphere(), clear()
    opened(0, ROUND)
    stage.put(*cloud(3))
    e.mark_outflow()
    first, marked = e.outflow_counts(), names(stage)
    e.mark_outflow()
    np.testing.assert_array_equal(e.outflow_counts(), first)
    np.testing.assert_array_equal(names(stage), marked)
    assert first.sum() == (marked < 0).sum() > 0


def test_a_shut_exit_lets_nothing_out():
    stage, e = sphere(), clear()
    opened(0, ROUND)
    opened(1, CUT)
    e.close(0)
    e.close(1)
    x, _ = cloud(4)
    stage.put(0.8 * x)
    e.mark_outflow()
    assert e.outflow_counts().tolist() == [0] * 6
    np.testing.assert_array_equal(names(stage), np.arange(len(x)))


@pytest.mark.parametrize("most", [0, 1, 7, 10_000])
def test_suction_takes_the_first_so_many_that_are_near(most):
    stage, e = sphere(), clear()
    x, v = cloud(5)
    gone = np.arange(0, len(x), 5)
    identity = np.arange(len(x))
    identity[gone] = -4
    tip, reach = np.array([1.0, -2.0, 0.5]) * D, 4.0 * D
    away = np.linalg.norm(x - tip, axis=1)
    assert np.abs(away - reach).min() > DOUBT[precision()] * D
    near = np.flatnonzero((away < reach) & (identity >= 0))
    assert len(near) > 10
    results = []
    for _ in range(3):
        clear()
        stage.put(x, v, identity)
        taken = aspirate(stage.particles, e, *tip, reach, most)
        results.append(names(stage))
        assert taken == min(most, len(near))
        assert e.outflow_counts().tolist() == [0, taken, 0, 0, 0, 0]
    expected = identity.copy()
    expected[near[:most]] = -2 - SUCTION
    for found in results:
        np.testing.assert_array_equal(found, expected)


def dripped(seed: int, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Mark a cloud at a time; positions and velocities of what has left through exit 2."""
    stage = sphere()
    opened(1, ROUND)
    opened(2, CUT, track_droplets=True)
    x, v = cloud(seed)
    stage.put(x, v)
    outlets().blood.time = time
    outlets().mark_outflow()
    left = names(stage) == -6
    return x[left], v[left]


def in_some_order(points: np.ndarray) -> np.ndarray:
    """Rows sorted by their first coordinate; threads leave drops in any order."""
    return points[points[:, 0].argsort()]


def droplets(time: float) -> np.ndarray:
    """Where they are at a time [s]."""
    outlets().blood.time = time
    return outlets().droplets()


@pytest.mark.parametrize("age", [0.0, 0.01, 0.25])
def test_droplets_follow_the_parabola_from_where_they_left(age):
    clear()
    x, v = dripped(6, 0.5)
    assert len(x) > 5
    found = droplets(0.5 + age)
    expected = x + v * age + 0.5 * np.array(GRAVITY) * age**2
    # The time of leaving is rounded too.
    limit = ROUNDING[precision()] * (0.5 + np.abs(expected).max())
    np.testing.assert_allclose(in_some_order(found), in_some_order(expected), rtol=0, atol=limit)


def test_droplets_are_forgotten_after_a_while_and_are_not_there_before_they_left():
    clear()
    early, _ = dripped(7, 0.1)
    late, _ = dripped(8, 0.3)
    assert len(droplets(0.05)) == 0
    assert len(droplets(0.2)) == len(early)
    assert len(droplets(0.35)) == len(early) + len(late)
    assert len(droplets(0.1 + DROPLET_TIME + 0.05)) == len(late)
    assert len(droplets(9.0)) == 0


def test_only_the_latest_droplets_are_remembered():
    clear()
    marks, total = 0, 0
    while total <= MOST_DROPLETS:
        marks += 1
        total += len(dripped(9, 0.001 * marks)[0])
    each = total // marks
    # All of the last ones are among them.
    assert len(droplets(0.001 * marks)) == MOST_DROPLETS
    assert len(droplets(0.001 * (marks - 2) + DROPLET_TIME + 0.0005)) == 2 * each
    assert outlets().outflow_counts()[4] == total
