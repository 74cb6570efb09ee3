import itertools
import re
from dataclasses import replace

import numpy as np
import pytest

from builders import (
    BOX,
    CAPACITY,
    SKIN,
    SPHERE,
    D,
    R,
    Setup,
    ball,
    float_dtype,
    jittered_lattice,
    make_fluid,
    periodic,
    plane,
    precision,
    sphere,
)
from reference import proxy_volumes, separations
from taichi_sph.errors import RunError
from taichi_sph.fluid.rheology import Casson
from taichi_sph.particles.grid import cells_within, make_grid
from taichi_sph.particles.neighbors import Neighbors, list_capacity

ROUNDING = {"f64": 1e-12, "f32": 1e-5}
"""Pairs this near to the radius, relatively, may be told either way."""
VOLUME = {"f64": 1e-12, "f32": 1e-5}
"""Sums of some ten kernel values, or positions rounded to 1e-7 of a box of nine support radii."""

REACH = R + SKIN
BLOOD = make_fluid(rheology=Casson(3.5e-3, 5e-3, 7.0), alpha=0.05, background=50.0)
STAGES = {"periodic": periodic, "plane": plane, "sphere": sphere}


def corners(stage: Setup) -> tuple[np.ndarray, np.ndarray]:
    grid = stage.neighbors.grid
    lower = np.array(grid.lower)
    return lower, lower + np.array(grid.cell) * np.array(grid.shape)


def cloud(stage: Setup, generator: np.random.Generator) -> np.ndarray:
    """Random points, points on cell faces, edges and corners, points on the box, (n, 3)."""
    lower, upper = corners(stage)
    middle = np.clip(0.5 * (lower + upper), lower, lower + 6 * D)
    free = generator.uniform(np.maximum(lower, middle - 5 * D), middle + 5 * D, (300, 3))
    if stage is periodic():
        free = generator.uniform(lower, upper, (400, 3))
    cell = np.array(stage.neighbors.grid.cell)
    on_faces = free[:60].copy()
    snapped = lower + np.round((on_faces - lower) / cell) * cell
    some = generator.random(on_faces.shape) < 0.6
    on_faces[some] = snapped[some]
    ends = np.array(list(itertools.product(*zip(lower, np.nextafter(upper, lower), strict=True))))
    beside = ends + generator.uniform(0.0, 0.5 * D, ends.shape) * np.sign(middle - ends)
    x = np.concatenate([free, on_faces, ends, beside]).astype(float_dtype()).astype(float)
    # A coordinate that f32 rounds up to the end of a period belongs to its beginning.
    return np.where((stage.period > 0) & (x >= upper), lower, x)


def matrices(stage: Setup) -> tuple[np.ndarray, np.ndarray]:
    """Lists as truth tables over rows, (n, n) and (n, m); an entry given twice is refused."""
    nb = stage.neighbors
    n = stage.particles.count[None]
    tables = []
    for count, index, width in (
        (nb.blood_count, nb.blood_index, n),
        (nb.wall_count, nb.wall_index, stage.wall.count),
    ):
        counts, indices = count.to_numpy()[:n], index.to_numpy()[:n]
        table = np.zeros((n, width), int)
        row, slot = np.nonzero(np.arange(indices.shape[1]) < counts[:, None])
        np.add.at(table, (row, indices[row, slot]), 1)
        assert table.max(initial=0) <= 1
        tables.append(table.astype(bool))
    return tables[0], tables[1]


def distances(stage: Setup) -> tuple[np.ndarray, np.ndarray]:
    """Distances between rows and from rows to proxies; infinite from a row to itself [m]."""
    n = stage.particles.count[None]
    x = stage.particles.position.to_numpy()[:n].astype(float)
    y = stage.wall.position.to_numpy()[: stage.wall.count].astype(float)
    blood = np.linalg.norm(separations(x, x, stage.period), axis=-1)
    np.fill_diagonal(blood, np.inf)
    return blood, np.linalg.norm(separations(x, y, stage.period), axis=-1)


def assert_lists_are_brute_force(stage: Setup) -> None:
    for listed, distance in zip(matrices(stage), distances(stage), strict=True):
        certain = np.abs(distance / REACH - 1.0) > ROUNDING[precision()]
        np.testing.assert_array_equal(listed[certain], (distance < REACH)[certain])


@pytest.mark.parametrize("name", STAGES)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_lists_are_what_brute_force_finds(name, seed):
    stage = STAGES[name]()
    x = cloud(stage, np.random.default_rng(seed))
    stage.put(x)
    stage.build()
    assert stage.particles.count[None] == len(x)
    blood, wall = matrices(stage)
    assert blood.any() and (wall.any() or stage.wall.count == 0)
    assert_lists_are_brute_force(stage)


def test_cells_away_from_the_vessel_change_no_list():
    stage = sphere()
    whole = stage.neighbors
    # Small cells, so that blocks of them are smaller than the round vessel.
    grid = make_grid(np.full(3, -20 * D), np.full(3, 25 * D), REACH / 2)
    fine = replace(grid, reach=(2, 2, 4))
    used = cells_within(fine, lambda x: np.linalg.norm(x, axis=1) - SPHERE, 3.0 * D)
    assert used.mean() < 0.3
    corner = np.argwhere(used.reshape(fine.shape)) * np.array(fine.cell) + np.array(fine.lower)
    for axis in range(3):  # the vessel and its margin, to within a cell
        assert corner[:, axis].min() <= -SPHERE - 3.0 * D
        assert corner[:, axis].max() >= SPHERE + 3.0 * D - fine.cell[axis]
    few = Neighbors.allocate(fine, R, SKIN, CAPACITY, D, stage.wall, used)
    stage.put(ball(np.random.default_rng(5), SPHERE - 0.2 * D))
    stage.build()
    particles = stage.particles
    x = stage.in_order(particles.position)
    expected = [set(row) for row in by_identity(stage, whole)]
    few.sort_wall(stage.wall)
    few.build(particles, stage.wall)
    np.testing.assert_array_equal(stage.in_order(particles.position), x)
    assert [set(row) for row in by_identity(stage, few)] == expected
    walls = few.wall_count.to_numpy()[: len(x)]
    # A stray beyond all cells in use is found by nobody, and spoils nothing.
    stray = np.vstack([x, [[24 * D, 24 * D, 24 * D], [-19 * D, 0.0, 0.0]]])
    stage.put(stray)
    few.build(particles, stage.wall)
    lists = by_identity(stage, few)
    assert [set(row) for row in lists[: len(x)]] == expected
    assert lists[len(x) :] == [[], []]
    assert few.wall_count.to_numpy()[: len(stray)].sum() == walls.sum()
    stage.neighbors.sort_wall(stage.wall)


def by_identity(stage: Setup, neighbors: Neighbors) -> list[list[int]]:
    """Identities on each particle's list, by identity."""
    n = stage.particles.count[None]
    name = stage.particles.identity.to_numpy()[:n]
    count, index = neighbors.blood_count.to_numpy(), neighbors.blood_index.to_numpy()
    lists: list[list[int]] = [[] for _ in range(n)]
    for row in range(n):
        lists[name[row]] = sorted(name[index[row, : count[row]]].tolist())
    return lists


def test_blood_that_has_left_the_box_still_finds_its_neighbours():
    stage, generator = sphere(), np.random.default_rng(3)
    _, upper = corners(stage)
    stage.put(generator.uniform(upper - 2 * D, upper + 4 * D, (200, 3)))
    stage.build()
    assert matrices(stage)[0].any()
    assert_lists_are_brute_force(stage)


@pytest.mark.parametrize("name", STAGES)
def test_five_rebuilds_give_bitwise_equal_lists(name):
    stage = STAGES[name]()
    stage.put(cloud(stage, np.random.default_rng(4)))
    nb, results = stage.neighbors, []
    for _ in range(5):
        stage.build()
        n = stage.particles.count[None]
        results.append([f.to_numpy()[:n] for f in (nb.blood_count, nb.wall_count)])
        for count, index in ((nb.blood_count, nb.blood_index), (nb.wall_count, nb.wall_index)):
            used = np.arange(index.shape[1])[None, :] < count.to_numpy()[:n, None]
            results[-1].append(np.where(used, index.to_numpy()[:n], -1))
    for other in results[1:]:
        for first, again in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(first, again)


def test_lists_name_all_within_reach_when_all_have_moved_just_under_half_the_skin():
    stage, generator = sphere(), np.random.default_rng(5)
    pairs = 40
    # Half of the particles stand just outside another's list and walk straight at it.
    x = generator.uniform(-5 * D, 5 * D, (2 * pairs, 3))
    toward = generator.normal(size=(pairs, 3))
    toward /= np.linalg.norm(toward, axis=1)[:, None]
    x[pairs:] = x[:pairs] + (R + 0.998 * SKIN) * toward
    loose = generator.uniform(-5 * D, 5 * D, (300, 3))
    random = generator.normal(size=loose.shape)
    random /= np.linalg.norm(random, axis=1)[:, None]
    x = np.concatenate([x, loose])
    step = 0.4999 * SKIN * np.concatenate([toward, -toward, random])
    stage.put(x)
    stage.build()
    names = stage.particles.identity.to_numpy()[: len(x)]
    moved = np.zeros((CAPACITY, 3), float_dtype())
    moved[: len(x)] = (x + step)[names]
    stage.particles.position.from_numpy(moved)
    for listed, distance in zip(matrices(stage), distances(stage), strict=True):
        assert (distance < R).any()
        assert listed[distance < R * (1 - ROUNDING[precision()])].all()


def test_removed_particles_vanish_and_the_rest_keep_state_and_lists():
    stage, generator = sphere(), np.random.default_rng(6)
    x = generator.uniform(-5 * D, 5 * D, (300, 3))
    v = generator.normal(size=x.shape)
    names = np.arange(300)
    gone = generator.choice(300, 90, replace=False)
    names[gone] = generator.choice([-1, -2, -5], 90)
    stage.put(x, v, names)
    stage.build()
    kept = np.setdiff1d(np.arange(300), gone)
    assert stage.particles.count[None] == 210
    np.testing.assert_array_equal(stage.particles.identities(), kept)
    np.testing.assert_array_equal(
        stage.in_order(stage.particles.position), x[kept].astype(float_dtype())
    )
    np.testing.assert_array_equal(
        stage.in_order(stage.particles.velocity), v[kept].astype(float_dtype())
    )
    assert_lists_are_brute_force(stage)


def test_removing_every_particle_leaves_none():
    stage = sphere()
    stage.put(np.random.default_rng(7).uniform(-D, D, (50, 3)), identity=np.full(50, -2))
    stage.build()
    assert stage.particles.count[None] == 0


@pytest.mark.parametrize("name", STAGES)
def test_shuffling_the_rows_changes_no_particle_bitwise(name):
    stage, generator = STAGES[name](), np.random.default_rng(8)
    x = jittered_lattice(generator) - (4.0 * D if name == "sphere" else 0.0)
    v = generator.normal(size=x.shape) * 0.1
    states = []
    for order in (np.arange(len(x)), generator.permutation(len(x)), generator.permutation(len(x))):
        stage.put(x[order], v[order], order)
        acceleration = stage.accelerate(BLOOD)
        p = stage.particles
        states.append([acceleration, *(stage.in_order(f) for f in (p.position, p.density))])
    for state in states[1:]:
        for first, again in zip(states[0], state, strict=True):
            np.testing.assert_array_equal(first, again)


@pytest.mark.parametrize("name", STAGES)
def test_too_many_blood_neighbours_are_refused_with_their_number(name):
    stage, generator = STAGES[name](), np.random.default_rng(9)
    capacity = stage.neighbors.blood_capacity
    clump = 4 * D + generator.uniform(-0.5 * D, 0.5 * D, (capacity + 2, 3))
    stage.put(clump)
    expected = rf"{capacity + 1} blood neighbours within 0\.0024 m, the list holds {capacity}: "
    with pytest.raises(RunError, match=expected):
        stage.build()


@pytest.mark.parametrize("name", STAGES)
def test_a_full_list_is_complete(name):
    stage, generator = STAGES[name](), np.random.default_rng(10)
    capacity = stage.neighbors.blood_capacity
    clump = 4 * D + generator.uniform(-0.5 * D, 0.5 * D, (capacity + 1, 3))
    others = 4 * D + generator.uniform(-3.9 * D, 3.9 * D, (200, 3))
    far = np.linalg.norm(separations(others, clump, stage.period), axis=-1).min(axis=1) > REACH
    stage.put(np.concatenate([clump, others[far]]))
    stage.build()
    assert matrices(stage)[0].sum(axis=1).max() == capacity
    assert_lists_are_brute_force(stage)


def test_too_many_proxies_are_refused_with_their_number():
    stage = sphere()
    m, capacity = stage.wall.count, stage.neighbors.wall_capacity
    assert m > capacity
    crowd = np.random.default_rng(11).uniform(-D, D, (m, 3))
    try:
        stage.put_wall(crowd, stage.wall_normal)
        stage.put(np.zeros((1, 3)))
        expected = re.escape(f"{m} wall neighbours within 0.0024 m, the list holds {capacity}: ")
        with pytest.raises(RunError, match=expected):
            stage.build()
    finally:
        stage.put_wall(stage.wall_position, stage.wall_normal)


@pytest.mark.parametrize("name", ["plane", "sphere"])
def test_sorting_the_wall_keeps_each_proxy_whole(name):
    stage = STAGES[name]()
    fields = (stage.wall.position, stage.wall.normal, stage.wall.volume)
    position, normal, volume = (f.to_numpy().astype(float) for f in fields)
    found = np.linalg.norm(position[:, None] - stage.wall_position[None], axis=-1).argmin(axis=1)
    assert len(set(found)) == stage.wall.count
    # Not the order they came in: otherwise this test shows nothing.
    assert np.any(found != np.arange(stage.wall.count))
    np.testing.assert_allclose(position, stage.wall_position[found], atol=1e-6 * R, rtol=0)
    np.testing.assert_allclose(normal, stage.wall_normal[found], atol=1e-6, rtol=0)
    expected = proxy_volumes(stage.wall_position, R, stage.period)[found]
    np.testing.assert_allclose(volume, expected, rtol=VOLUME[precision()])


def test_a_period_shorter_than_the_lists_reach_around_is_refused():
    with pytest.raises(ValueError, match="a periodic axis"):
        make_grid(np.zeros(3), np.full(3, BOX), 0.5 * BOX, np.full(3, BOX))


def test_a_grid_beyond_memory_is_refused_with_its_size():
    with pytest.raises(RunError, match=r"grid would need 2e\+15 cells"):
        make_grid(np.zeros(3), np.ones(3), 1e-5)


@pytest.mark.parametrize("expected", [0.0, 1.0, 33.0, 57.9, 1000.0])
def test_a_list_has_room_for_half_as_many_again_and_sixteen(expected):
    assert list_capacity(expected) >= 1.5 * expected + 16
    assert list_capacity(expected) % 8 == 0
