import numpy as np
import pytest

from builders import (
    CAPACITY,
    SEPTUM,
    SPHERE,
    D,
    Prescribed,
    Setup,
    calibration,
    float_dtype,
    periodic,
    plane,
    precision,
    sphere,
)
from taichi_sph.integrator import WALL_MARGIN, kick_drift, largest_speed_and_acceleration
from taichi_sph.simulation import Simulation

MAP = {"f64": 1e-9, "f32": 1e-3}
"""Displacements of 1e-3 d are told from positions of 4 d, to rounding; the map's entries are 1."""
SLOPE = 0.05
"""How far the fitted order of convergence may stray: the next term is a hundredth of the first."""
SURFACE = {"f64": 1e-12, "f32": 1e-5}
"""Rounding of a position, in spacings: heights are a few spacings."""
GUARD = WALL_MARGIN
MIDDLE = np.full(3, 4.0 * D)
OMEGA = 20.0


def still(x: np.ndarray) -> np.ndarray:
    return np.zeros_like(x)


def spring(x: np.ndarray) -> np.ndarray:
    """A harmonic trap about the middle of the periodic stage [m/s^2]."""
    return -(OMEGA**2) * (x - MIDDLE)


def one_step_map(printed: bool, w: float) -> np.ndarray:
    """The linear map of (w x, v dt ... ) over one step of a harmonic sim, (2, 2), per axis."""
    stage, dt, small = periodic(), w / OMEGA, 0.5 * D
    # Two trajectories: displaced at rest, and moving through the middle.
    x = MIDDLE + np.array([[small] * 3, [0.0] * 3])
    v = np.array([[0.0] * 3, [OMEGA * small] * 3])
    stage.put(x, v)
    stage.build()
    acceleration = np.zeros((CAPACITY, 3), float_dtype())
    acceleration[:2] = spring(stage.particles.position.to_numpy()[:2].astype(float))
    stage.particles.acceleration.from_numpy(acceleration)
    stage.particles.shifting.fill(0.0)
    kick_drift(stage.particles, stage.wall, stage.neighbors, None, printed, dt, 0.0)
    after_x = (stage.in_order(stage.particles.position) - MIDDLE) / small
    after_v = stage.in_order(stage.particles.velocity) / (OMEGA * small)
    return np.stack([after_x, after_v], axis=1)


@pytest.mark.parametrize("w", [0.1, 0.5, 1.5])
def test_symplectic_step_maps_a_harmonic_motion_with_determinant_one(w):
    states = one_step_map(False, w)
    for axis in range(3):
        expected = np.array([[1 - w**2, w], [-w, 1.0]])
        np.testing.assert_allclose(states[:, :, axis].T, expected, atol=MAP[precision()], rtol=0)
        assert np.linalg.det(states[:, :, axis]) == pytest.approx(1.0, abs=3 * MAP[precision()])


@pytest.mark.parametrize("w", [0.1, 0.5, 1.5])
def test_printed_step_amplifies_a_harmonic_motion_by_half_the_square_of_its_phase(w):
    states = one_step_map(True, w)
    for axis in range(3):
        determinant = np.linalg.det(states[:, :, axis])
        assert determinant == pytest.approx(1.0 + 0.5 * w**2, abs=3 * MAP[precision()])


def swing(printed: bool, w: float, steps: int) -> Simulation:
    """A harmonic sim of phase w a step, displaced by half a spacing at the start."""
    stage = periodic()
    stage.put(MIDDLE[None] + 0.5 * D)
    model = Prescribed(spring, w / OMEGA)
    sim = stage.simulation(model, integrator="paper" if printed else "symplectic")
    sim.advance_to(steps * w / OMEGA)
    assert sim.steps == steps
    return sim


def amplitude(sim: Simulation) -> float:
    x, v = sim.particles.position.to_numpy()[0], sim.particles.velocity.to_numpy()[0]
    return float(np.hypot(x[0] - MIDDLE[0], v[0] / OMEGA) / (0.5 * D))


@pytest.mark.parametrize("w", [0.2, 1.0, 1.9])
def test_symplectic_step_keeps_a_harmonic_motion_bounded_up_to_a_phase_of_two(w):
    # The ellipse of the map stretches to 1/sqrt(1 - w/2).
    assert amplitude(swing(False, w, 100)) < 1.001 / np.sqrt(1 - 0.5 * w)


def test_symplectic_step_is_unstable_beyond_a_phase_of_two():
    assert amplitude(swing(False, 2.1, 20)) > 10.0


def test_printed_step_grows_as_its_determinant_says():
    w, steps = 0.3, 100
    assert amplitude(swing(True, w, steps)) == pytest.approx(
        (1 + 0.5 * w**2) ** (0.5 * steps), rel=0.2
    )


@pytest.mark.skipif("config.getoption('--precision') == 'f32'", reason="rounding hides the order")
def test_symplectic_step_converges_with_order_one():
    # Over a quarter of a period a displaced particle comes to the middle.
    steps = np.array([40, 80, 160, 320])
    errors = []
    for n in steps:
        sim = swing(False, 0.5 * np.pi / n, int(n))
        errors.append(abs(sim.particles.position.to_numpy()[0, 0] - MIDDLE[0]))
    order = np.polyfit(np.log(1.0 / steps), np.log(errors), 1)[0]
    assert order == pytest.approx(1.0, abs=SLOPE)


@pytest.mark.parametrize("printed", [False, True])
def test_uniform_motion_is_exact(printed):
    stage, v = periodic(), np.array([0.3, -0.2, 0.1])
    stage.put(MIDDLE[None], v[None])
    sim = stage.simulation(Prescribed(still, 1e-3), integrator="paper" if printed else "symplectic")
    sim.advance_to(0.01)
    np.testing.assert_allclose(
        stage.in_order(stage.particles.position)[0], MIDDLE + 0.01 * v,
        rtol=0, atol=SURFACE[precision()] * D,
    )  # fmt: skip


def test_blood_that_leaves_a_period_comes_in_again_on_the_other_side():
    stage = periodic()
    x = np.array([[7.9 * D, 0.1 * D, 4.0 * D]])
    stage.put(x, np.array([[0.2, -0.2, 0.0]]))
    stage.simulation(Prescribed(still, 1e-3)).advance_to(1e-3)
    expected = np.array([0.1, 7.9, 4.0]) * D
    np.testing.assert_allclose(
        stage.in_order(stage.particles.position)[0], expected, atol=SURFACE[precision()] * D, rtol=0
    )
    # How far it has moved since the lists were built is told across the period's end.
    moved2, _ = kick_drift(stage.particles, stage.wall, stage.neighbors, None, False, 0.0, 0.0)
    assert np.sqrt(moved2) == pytest.approx(np.hypot(0.2, 0.2) * D, rel=1e-4)


def shoot(stage: Setup, x, v, steps: int, per_step: float) -> Simulation:
    """Lone drops without any force, a distance a step; returns the sim at its end."""
    x, v = np.atleast_2d(x), np.atleast_2d(v)
    dt = per_step / np.linalg.norm(v, axis=1).max()
    stage.put(x, v)
    sim = stage.simulation(Prescribed(still, dt))
    sim.advance_to(steps * dt)
    return sim


@pytest.mark.parametrize("per_step", [0.05 * D, 0.2 * D, 1.0 * D])
@pytest.mark.parametrize("angle", [45.0, 90.0])
def test_lone_drop_shot_at_a_plane_wall_stays_inside_and_is_counted(angle, per_step):
    stage, turn = plane(), np.radians(angle)
    # Four places above the lattice of proxies, over one of them and between them.
    x = np.array([[4.0, 4.0, 2.0], [4.3, 4.1, 2.0], [4.44, 4.44, 2.0], [4.44, 4.0, 2.0]]) * D
    v = np.tile([np.cos(turn), 0.0, -np.sin(turn)], (4, 1))
    sim = shoot(stage, x, v, round(6 * D / per_step), per_step)
    closest = GUARD * calibration().setback
    height = stage.in_order(stage.particles.position)[:, 2]
    np.testing.assert_allclose(height, closest, rtol=0, atol=SURFACE[precision()] * D)
    assert sim.wall_corrections >= 4


@pytest.mark.parametrize("angle", [30.0, 45.0, 80.0])
def test_drop_at_the_wall_loses_its_velocity_into_the_wall_and_no_other(angle):
    stage, turn = plane(), np.radians(angle)
    v = np.array([np.cos(turn), 0.0, -np.sin(turn)])
    shoot(stage, np.array([4.1, 4.2, 1.0]) * D, v, 30, 0.2 * D)
    expected = [np.cos(turn), 0.0, 0.0]
    found = stage.in_order(stage.particles.velocity)[0]
    np.testing.assert_allclose(found, expected, rtol=0, atol=SURFACE[precision()])


def test_drop_that_leaves_the_wall_is_let_go():
    stage = plane()
    x, v = np.array([4.1 * D, 4.2 * D, 0.11 * calibration().setback]), np.array([0.5, 0.0, 0.5])
    sim = shoot(stage, x, v, 10, 0.2 * D)
    assert sim.wall_corrections == 0
    np.testing.assert_array_equal(
        stage.in_order(stage.particles.velocity)[0], v.astype(float_dtype()).astype(float)
    )


def test_drops_shot_about_in_a_round_vessel_stay_inside():
    stage, generator = sphere(), np.random.default_rng(0)
    v = generator.normal(size=(80, 3))
    v /= np.linalg.norm(v, axis=1)[:, None]
    x = generator.uniform(-2 * D, 2 * D, v.shape)
    sim = shoot(stage, x, v, 60, 0.2 * D)
    outermost = np.linalg.norm(stage.in_order(stage.particles.position), axis=1).max()
    assert 0.9 * SPHERE < outermost < SPHERE
    assert sim.wall_corrections >= 80


@pytest.mark.parametrize("side", [-1.0, 1.0], ids=["below", "above"])
@pytest.mark.parametrize("gap", [0.1, 0.3, 1.0])
def test_blood_beyond_a_thin_septum_is_not_pulled_over(side, gap):
    stage = plane()
    face = SEPTUM[0] if side < 0 else SEPTUM[1]
    height = face + side * (gap + 1e-3) * calibration().setback
    generator = np.random.default_rng(1)
    x = np.column_stack([generator.uniform(0, 8 * D, (50, 2)), np.full(50, height)])
    # Along the septum, past every place above its proxies.
    v = np.tile([0.6, 0.8, 0.0], (50, 1))
    sim = shoot(stage, x, v, 40, 0.1 * D)
    assert sim.wall_corrections == 0
    np.testing.assert_allclose(
        stage.in_order(stage.particles.position)[:, 2], height, atol=20 * SURFACE[precision()] * D
    )


@pytest.mark.parametrize("side", [-1.0, 1.0], ids=["from below", "from above"])
@pytest.mark.parametrize("angle", [45.0, 90.0])
def test_drop_shot_at_a_thin_septum_stays_on_its_side(side, angle):
    stage, turn = plane(), np.radians(angle)
    face = SEPTUM[0] if side < 0 else SEPTUM[1]
    x = np.array([[4.0 * D, 4.2 * D, face + side * 1.5 * D]])
    v = np.array([[np.cos(turn), 0.0, -side * np.sin(turn)]])
    sim = shoot(stage, x, v, 40, 0.2 * D)
    closest = face + side * GUARD * calibration().setback
    assert stage.in_order(stage.particles.position)[0, 2] == pytest.approx(
        closest, abs=20 * SURFACE[precision()] * D
    )
    assert sim.wall_corrections > 0


def test_survey_tells_the_largest_speed_and_acceleration_and_counts_what_is_not_finite():
    stage, generator = periodic(), np.random.default_rng(2)
    x, v = generator.uniform(0, 8 * D, (300, 3)), generator.normal(size=(300, 3))
    stage.put(x, v)
    acceleration = np.zeros((CAPACITY, 3), float_dtype())
    acceleration[:300] = generator.normal(size=(300, 3))
    # Rows that are not live are not looked at.
    acceleration[300:] = np.nan
    stage.particles.acceleration.from_numpy(acceleration)
    speed, largest, broken = largest_speed_and_acceleration(stage.particles)
    assert speed == pytest.approx(np.linalg.norm(v, axis=1).max(), rel=1e-6)
    assert largest == pytest.approx(np.linalg.norm(acceleration[:300], axis=1).max(), rel=1e-6)
    assert broken == 0
    v[[3, 70]] = [[np.nan, 0, 0], [0, np.inf, 0]]
    acceleration[200] = -np.inf
    stage.put(x, v)
    stage.particles.acceleration.from_numpy(acceleration)
    assert largest_speed_and_acceleration(stage.particles)[2] == 3
