"""Every sum against brute force, and what must hold whatever the numbers: laws of conservation,
independence of the frame of reference and of the numbering."""

import math

import numpy as np
import pytest

from builders import (
    DENSITY,
    KERNEL,
    SPHERE,
    D,
    R,
    Setup,
    ball,
    calibration,
    jittered_lattice,
    make_fluid,
    make_model,
    periodic,
    plane,
    precision,
    sphere,
)
from reference import Blood
from taichi_sph.fluid.rheology import Casson, Newtonian
from taichi_sph.fluid.wcsph import SphAcceleration

SUMS = {"f64": 1e-11, "f32": 2e-4}
"""Of the largest value: sums of some 40 terms; in f32 (rho/rho_0)^7 multiplies 1e-6 by seven."""
SERIES = 1e-7
"""The law's exponential is a series of three terms near rest (see test_rheology)."""
MOMENTUM = {"f64": 1e-13, "f32": 2e-6}
"""Of the sum of magnitudes: each pair cancels but for its rounding."""
FRAME = {"f64": 1e-9, "f32": 5e-3}
"""Of the largest value: adding 10 m/s to 0.1 m/s, or 1 mm to 1 um, costs two to three digits."""
DERIVATIVE = {"f64": 1e-6, "f32": 1e-3}
"""A central difference over d/20000 leaves its square times a hundred; f32 rounds the force."""

GRAVITY = (1.0, -2.0, -9.81)
CASSON = Casson(3.5e-3, 5e-3, 7.0)

# A background above rho_0 c^2/7 keeps the pressure off its bound, however thin blood is.
PRESSURE = make_fluid(background=300.0)
# A pressure bounded at zero everywhere leaves the artificial term alone.
ARTIFICIAL = make_fluid(background=-1e9, alpha=0.3)
VISCOUS = make_fluid(sound_speed=0.0, rheology=Newtonian(3.5e-3))
DAMPING = make_fluid(background=300.0, damping=1.0)
THIN = make_fluid(background=-1e9, thin=0.3)
# As scenes have it, and the scene's own alpha beside.
SCENE: dict = {"rheology": CASSON, "alpha": 0.05, "damping": 1.0, "thin": 0.05}
BLOOD = make_fluid(background=300.0, **SCENE)
NESTED = make_fluid(background=300.0, nested=True, **SCENE)

CONSERVING = {
    "pressure": PRESSURE,
    "artificial": ARTIFICIAL,
    "thin": THIN,
    "damping of sound": DAMPING,
    "viscous": VISCOUS,
    "blood": BLOOD,
    "nested": NESTED,
}


def velocities(x: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """A shear of 50 1/s with noise of some cm/s [m/s]."""
    return np.roll(50.0 * x, 1, axis=1) + 0.03 * generator.normal(size=x.shape)


def near_the_wall(seed: int) -> Setup:
    """Blood that fills the round vessel up to a fifth of a spacing from its wall."""
    generator = np.random.default_rng(seed)
    x = ball(generator, SPHERE - 0.2 * D)
    stage = sphere()
    stage.put(x, velocities(x, generator))
    return stage


def lone_drops(seed: int) -> Setup:
    """Drops near the round wall that do not reach each other: they feel the wall alone."""
    generator = np.random.default_rng(seed)
    directions = np.concatenate([np.eye(3), -np.eye(3)])
    turn, _ = np.linalg.qr(generator.normal(size=(3, 3)))
    x = directions @ turn * generator.uniform(SPHERE - 0.6 * D, SPHERE - 0.1 * D, (6, 1))
    stage = sphere()
    stage.put(x, 0.1 * generator.normal(size=x.shape))
    return stage


def filled_box(seed: int) -> Setup:
    generator = np.random.default_rng(seed)
    x = jittered_lattice(generator)
    stage = periodic()
    stage.put(x, velocities(x, generator))
    return stage


PLACES = {"near the wall": near_the_wall, "lone drops": lone_drops, "filled box": filled_box}


def assert_close(found: np.ndarray, expected: np.ndarray, relative: float) -> None:
    """Equal to within a part of the largest value, which must not be zero."""
    scale = np.abs(expected).max()
    assert scale > 0.0
    np.testing.assert_allclose(found, expected, rtol=0, atol=relative * scale)


def assert_parts_add_up(found, from_blood, from_wall, place: str) -> None:
    """The sum of both parts; near a wall each must be large enough to be missed."""
    if place == "near the wall":
        parts = np.abs(from_blood).max(), np.abs(from_wall).max()
        assert min(parts) > 0.01 * max(parts)
    assert_close(found, from_blood + from_wall, SUMS[precision()])


@pytest.mark.parametrize("place", PLACES)
def test_density_is_equation_2(place):
    stage = PLACES[place](0)
    stage.accelerate(PRESSURE)
    assert_close(
        stage.in_order(stage.particles.density), stage.reference(PRESSURE).rho, SUMS[precision()]
    )


@pytest.mark.parametrize("place", ["near the wall", "filled box"])
def test_pressure_acceleration_is_equation_13_and_the_walls_part_equation_15(place):
    stage = PLACES[place](1)
    found, blood = stage.accelerate(PRESSURE), stage.reference(PRESSURE)
    assert_parts_add_up(
        found, blood.pressure_acceleration(), blood.wall_pressure_acceleration(), place
    )


@pytest.mark.parametrize("place", ["near the wall", "filled box"])
def test_artificial_acceleration_is_monaghans(place):
    stage = PLACES[place](2)
    found, blood = stage.accelerate(ARTIFICIAL), stage.reference(ARTIFICIAL)
    assert blood.p.max() == 0.0
    assert_parts_add_up(
        found, blood.artificial_acceleration(), blood.wall_artificial_acceleration(), place
    )


@pytest.mark.parametrize("place", ["near the wall", "filled box"])
def test_viscous_acceleration_is_morris_and_the_walls_friction_equation_16(place):
    stage = PLACES[place](3)
    found, blood = stage.accelerate(VISCOUS), stage.reference(VISCOUS)
    assert blood.p.max() == 0.0
    assert_parts_add_up(
        found, blood.viscous_acceleration(), blood.wall_friction_acceleration(), place
    )


@pytest.mark.parametrize("place", ["near the wall", "filled box"])
def test_the_damping_of_sound_takes_what_work_it_does_against_compression(place):
    stage = PLACES[place](18)
    work = stage.reference(DAMPING).mass * stage.in_order(stage.particles.velocity)
    force = stage.accelerate(DAMPING) - stage.accelerate(PRESSURE)
    blood = stage.reference(DAMPING)
    assert_close(
        force,
        blood.pressure_acceleration()
        + blood.wall_pressure_acceleration()
        - stage.reference(PRESSURE).pressure_acceleration()
        - stage.reference(PRESSURE).wall_pressure_acceleration(),
        10.0 * SUMS[precision()],
    )
    # -sum_i m q_i rho_0 (d(rho/rho_0)/dt)_i: with the derivative's own rate it is a square.
    assert (work * force).sum() < 0.0


def test_thin_blood_has_an_artificial_viscosity_and_other_blood_has_none():
    stage = near_the_wall(19)
    found, blood = stage.accelerate(THIN), stage.reference(THIN)
    thin = blood.surrounded(blood.rho)
    assert (thin == 0.0).any() and (thin == 1.0).any() and ((thin > 0.0) & (thin < 1.0)).any()
    assert blood.p.max() == 0.0
    expected = blood.artificial_acceleration(), blood.wall_artificial_acceleration()
    assert_parts_add_up(found, *expected, "near the wall")


def test_lone_drop_feels_the_walls_pressure_of_equation_15():
    stage = lone_drops(4)
    found, blood = stage.accelerate(PRESSURE), stage.reference(PRESSURE)
    assert_close(found, blood.wall_pressure_acceleration(), SUMS[precision()])


def test_lone_drop_that_nears_the_wall_feels_its_artificial_term():
    stage = lone_drops(5)
    found, blood = stage.accelerate(ARTIFICIAL), stage.reference(ARTIFICIAL)
    assert_close(found, blood.wall_artificial_acceleration(), SUMS[precision()])


def test_lone_drop_feels_the_walls_friction_of_equation_16():
    stage = lone_drops(6)
    found, blood = stage.accelerate(VISCOUS), stage.reference(VISCOUS)
    assert_close(found, blood.wall_friction_acceleration(), SUMS[precision()])


def test_the_walls_friction_is_along_the_velocity_and_against_it():
    stage = lone_drops(7)
    found, v = stage.accelerate(VISCOUS), stage.in_order(stage.particles.velocity)
    assert np.all((found * v).sum(axis=1) < 0.0)
    assert np.linalg.norm(np.cross(found, v)) < SUMS[precision()] * np.linalg.norm(found)


@pytest.mark.parametrize("fluid", [BLOOD, NESTED], ids=["pairwise", "nested"])
@pytest.mark.parametrize("place", PLACES)
def test_viscosity_is_cassons_of_the_shear_rate(place, fluid):
    stage = PLACES[place](8)
    stage.accelerate(fluid)
    found = stage.in_order(make_model(fluid).viscosity)
    expected = stage.reference(fluid).viscosity(nested=fluid.nested)
    assert expected.max() > 1.01 * expected.min()
    assert_close(found, expected, SUMS[precision()] + SERIES)


@pytest.mark.parametrize("fluid", [BLOOD, NESTED], ids=["pairwise", "nested"])
@pytest.mark.parametrize("place", PLACES)
def test_acceleration_is_the_sum_of_all_terms_and_gravity(place, fluid):
    stage = PLACES[place](9)
    found = stage.accelerate(fluid, GRAVITY)
    expected = stage.reference(fluid).acceleration(np.array(GRAVITY), nested=fluid.nested)
    assert_close(found, expected, SUMS[precision()] + SERIES)


def test_gravity_is_added_to_every_particle():
    stage = near_the_wall(10)
    without, within = stage.accelerate(BLOOD), stage.accelerate(BLOOD, GRAVITY)
    limit = SUMS[precision()] * np.abs(without).max()
    np.testing.assert_allclose(
        within - without, np.tile(GRAVITY, (len(within), 1)), rtol=0, atol=limit
    )


@pytest.mark.parametrize("name", CONSERVING)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_blood_without_a_wall_keeps_its_momentum(name, seed):
    stage = filled_box(seed)
    a = stage.accelerate(CONSERVING[name])
    magnitude = np.linalg.norm(a, axis=1).sum()
    assert magnitude > 0.0
    assert np.abs(a.sum(axis=0)).max() < MOMENTUM[precision()] * magnitude


@pytest.mark.parametrize("name", ["pressure", "artificial", "damping of sound"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_forces_along_the_line_of_two_particles_keep_angular_momentum(name, seed):
    generator = np.random.default_rng(seed)
    stage = periodic()
    # Three spacings from its own image: farther than the kernel reaches.
    x = ball(generator, 2.5 * D) + 4.0 * D
    stage.put(x, velocities(x, generator))
    a = stage.accelerate(CONSERVING[name])
    x = stage.in_order(stage.particles.position) - 4.0 * D
    torque = np.cross(x, a)
    magnitude = (np.linalg.norm(x, axis=1) * np.linalg.norm(a, axis=1)).sum()
    assert magnitude > 0.0
    assert np.abs(torque.sum(axis=0)).max() < MOMENTUM[precision()] * magnitude


@pytest.mark.parametrize("place", ["near the wall", "lone drops"])
def test_pressure_force_is_minus_the_derivative_of_the_internal_energy(place):
    stage = PLACES[place](11)
    force = calibration().mass * stage.accelerate(PRESSURE)
    at = stage.reference(PRESSURE)
    h = D / 20000.0
    scale = np.abs(force).max()
    # The particle nearest to the wall, where both parts of the force are large.
    i = np.linalg.norm(at.x, axis=1).argmax()
    for axis in range(3):
        energy = []
        for sign in (1.0, -1.0):
            x = at.x.copy()
            x[i, axis] += sign * h
            energy.append(Blood(**{**arguments(at), "x": x}).internal_energy())
        derivative = (energy[0] - energy[1]) / (2 * h)
        assert abs(force[i, axis] + derivative) < DERIVATIVE[precision()] * scale


def arguments(blood: Blood) -> dict:
    """What a reference state was made of."""
    return {name: getattr(blood, name) for name in Blood.__dataclass_fields__}


@pytest.mark.parametrize("fluid", [BLOOD, NESTED], ids=["pairwise", "nested"])
def test_blood_in_a_moving_train_accelerates_alike(fluid):
    generator = np.random.default_rng(12)
    x = jittered_lattice(generator)
    v = velocities(x, generator)
    stage = periodic()
    stage.put(x, v)
    at_rest = stage.accelerate(fluid)
    stage.put(x, v + np.array([10.0, -3.0, 5.0]))
    assert_close(stage.accelerate(fluid), at_rest, FRAME[precision()])


def transformed(stage: Setup, turn: np.ndarray, shift: np.ndarray, fluid) -> np.ndarray:
    """Accelerations of the blood and the wall, both turned and shifted; the wall is put back."""
    p = stage.particles
    x, v = stage.in_order(p.position), stage.in_order(p.velocity)
    try:
        stage.put_wall(stage.wall_position @ turn.T + shift, stage.wall_normal @ turn.T)
        stage.put(x @ turn.T + shift, v @ turn.T)
        return stage.accelerate(fluid)
    finally:
        stage.put_wall(stage.wall_position, stage.wall_normal)


@pytest.mark.parametrize("fluid", [BLOOD, NESTED], ids=["pairwise", "nested"])
def test_moving_blood_and_wall_together_changes_nothing(fluid):
    stage = near_the_wall(13)
    before = stage.accelerate(fluid)
    after = transformed(stage, np.eye(3), np.array([1.37, -0.71, 0.53]) * D, fluid)
    assert_close(after, before, FRAME[precision()])


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("fluid", [BLOOD, NESTED], ids=["pairwise", "nested"])
def test_turning_blood_and_wall_by_a_quarter_turns_the_accelerations(axis, fluid):
    a, b = (axis + 1) % 3, (axis + 2) % 3
    turn = np.zeros((3, 3))
    turn[axis, axis], turn[b, a], turn[a, b] = 1.0, 1.0, -1.0
    stage = near_the_wall(14)
    before = stage.accelerate(fluid)
    after = transformed(stage, turn, np.zeros(3), fluid)
    assert_close(after, before @ turn.T, FRAME[precision()])


def test_renumbering_the_particles_renumbers_the_accelerations():
    stage, generator = near_the_wall(15), np.random.default_rng(15)
    x, v = (stage.in_order(f) for f in (stage.particles.position, stage.particles.velocity))
    before = stage.accelerate(BLOOD)
    names = generator.permutation(len(x))
    stage.put(x, v, names)
    assert_close(stage.accelerate(BLOOD)[names], before, SUMS[precision()])


@pytest.mark.parametrize("fluid", [BLOOD, NESTED], ids=["pairwise", "nested"])
def test_accelerating_changes_neither_positions_nor_velocities_nor_the_wall(fluid):
    stage = near_the_wall(16)
    stage.build()
    p, w = stage.particles, stage.wall
    fields = (p.position, p.velocity, p.identity, w.position, w.normal, w.volume)
    before = [f.to_numpy() for f in fields]
    make_model(fluid).accelerate(p, w, stage.neighbors, GRAVITY)
    for field, values in zip(fields, before, strict=True):
        np.testing.assert_array_equal(field.to_numpy(), values)


@pytest.mark.parametrize("fluid", [BLOOD, NESTED], ids=["pairwise", "nested"])
def test_accelerating_twice_gives_bitwise_the_same(fluid):
    stage = near_the_wall(17)
    first = stage.accelerate(fluid, GRAVITY)
    np.testing.assert_array_equal(stage.accelerate(fluid, GRAVITY), first)


def test_lone_drop_close_to_a_plane_wall_is_pushed_off_it():
    stage = plane()
    stage.put(np.array([[4 * D, 4 * D, 0.1 * D]]))
    acceleration = stage.accelerate(PRESSURE)[0]
    assert acceleration[2] > 0.0
    assert np.abs(acceleration[:2]).max() < 0.2 * acceleration[2]


H = 0.5 * R
LIMITS = {
    "sound": (make_fluid(100.0, rheology=CASSON), 20.0, 1.0, 0.4 * H / 120.0),
    "sound in blood at rest": (make_fluid(100.0, rheology=CASSON), 0.0, 0.0, 0.4 * H / 100.0),
    "viscosity": (
        make_fluid(1e-3, rheology=Newtonian(2.0)), 0.0, 1e-3, 0.125 * H**2 * DENSITY / 2.0
    ),
    "viscosity of blood at rest": (
        make_fluid(1e-3, rheology=Casson(1.0, 1.0, 9.0)), 0.0, 0.0, 0.125 * H**2 * DENSITY / 16.0
    ),
    "force": (make_fluid(1e-3, rheology=CASSON), 0.0, 1e6, 0.25 * math.sqrt(H / 1e6)),
}  # fmt: skip


@pytest.mark.parametrize("name", LIMITS)
def test_stable_step_is_the_smallest_limit(name):
    fluid, speed, acceleration, limit = LIMITS[name]
    assert pytest.approx(KERNEL.smoothing_length) == H
    assert SphAcceleration(fluid, 1).stable_step(speed, acceleration) == pytest.approx(limit)
