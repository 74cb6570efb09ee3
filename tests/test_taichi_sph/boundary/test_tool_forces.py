"""What a tool that moves and turns does to blood, and blood to it, by brute force."""

from dataclasses import replace

import numpy as np
import pytest
from taichi import ndarray

from builders import (
    CAPACITY,
    WALL_SPACING,
    D,
    R,
    Setup,
    calibration,
    float_dtype,
    make_fluid,
    make_model,
    precision,
)
from nn.features import ROW_COUNT, SPEED_KURTOSIS, SPEED_SKEWNESS, FeatureScales, extract
from reference import Blood
from taichi_sph.boundary.boundary import BloodFlow, Datum
from taichi_sph.boundary.tool import Tool
from taichi_sph.fluid.implicit import ImplicitAcceleration
from taichi_sph.fluid.rheology import Casson
from taichi_sph.fluid.wcsph import force_on_tool, sum_acceleration
from taichi_sph.geometry.mesh import enclosed_volume
from tool_stage import AT, TURN, hold, proxies

SUMS = {"f64": 1e-11, "f32": 2e-4}
"""Of the largest value: sums of some 40 terms; in f32 (rho/rho_0)^7 multiplies 1e-6 by seven."""
SERIES = 1e-7
"""The law's exponential is a series of three terms near rest (see test_rheology)."""
FRAME = {"f64": 1e-9, "f32": 5e-3}
"""Of the largest value: adding 10 m/s to 0.1 m/s costs two to three digits."""
TRAIN = np.array([10.0, -3.0, 5.0])
"""Velocity of a moving train [m/s]."""

BLOOD = make_fluid(background=300.0, rheology=Casson(3.5e-3, 5e-3, 7.0), alpha=0.05)
NESTED = replace(BLOOD, nested=True)
THIN = make_fluid(rheology=Casson(3.5e-3, 5e-3, 7.0), alpha=0.05)
SCALES = FeatureScales(R, D, 4e-4, 2.0, WALL_SPACING / D)


class Moving(Blood):
    """The sums by brute force where proxies have volumes and velocities of their own."""

    v_k: np.ndarray

    def move(self, volume: np.ndarray, friction: np.ndarray, v_k: np.ndarray) -> "Moving":
        self.volume, self.friction_volume, self.v_k = volume, volume * friction, v_k
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
            psi = self.rest_density * self.friction_volume[None]
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
    moving = Moving(**{**arguments, "y": proxies(stage), "curvature": 0.0})
    return moving.move(*(proxies(stage, name) for name in ("volume", "friction", "velocity")))


def assert_close(found: np.ndarray, expected: np.ndarray, relative: float) -> None:
    scale = np.abs(expected).max()
    assert scale > 0.0
    np.testing.assert_allclose(found, expected, rtol=0, atol=relative * scale)


MOTION = ((0.2, -0.1, 0.15), (30.0, -50.0, 20.0))


@pytest.mark.parametrize("fluid", [BLOOD, NESTED], ids=["pairwise", "nested"])
def test_what_a_tool_that_moves_and_turns_does_to_blood_is_brute_force(stage, surface, fluid):
    hold(stage, surface, AT, TURN, *MOTION)
    found = stage.accelerate(fluid, (1.0, -2.0, -9.81))
    moving = brute_force(stage, fluid)
    assert_close(stage.in_order(make_model(fluid).viscosity), moving.viscosity(fluid.nested),
                 SUMS[precision()] + SERIES)  # fmt: skip
    expected = moving.acceleration(np.array([1.0, -2.0, -9.81]), nested=fluid.nested)
    assert_close(found, expected, SUMS[precision()] + SERIES)
    # The motion is large enough to be missed.
    still = moving.move(moving.volume, moving.friction_volume / moving.volume, 0.0 * moving.v_k)
    change = still.acceleration(np.array([1.0, -2.0, -9.81]), nested=fluid.nested) - expected
    assert np.abs(change).max() > 0.01 * np.abs(expected).max()


def in_the_train(stage: Setup) -> None:
    """Let blood, wall and tool move along."""
    v = stage.particles.velocity.to_numpy()
    stage.particles.velocity.from_numpy((v + TRAIN).astype(float_dtype()))
    velocity = proxies(stage, "velocity") + TRAIN
    stage.wall.velocity.from_numpy(velocity.astype(float_dtype()))


@pytest.mark.parametrize("fluid", [BLOOD, NESTED], ids=["pairwise", "nested"])
def test_blood_vessel_and_tool_in_a_moving_train_accelerate_alike(stage, surface, fluid):
    hold(stage, surface, AT, TURN, *MOTION)
    at_rest = stage.accelerate(fluid)
    in_the_train(stage)
    assert_close(stage.accelerate(fluid), at_rest, FRAME[precision()])


def test_the_implicit_pressure_in_a_moving_train_is_the_same(stage, surface):
    hold(stage, surface, AT, TURN, *MOTION)
    model = ImplicitAcceleration(THIN, CAPACITY, 2e-4, iterations=2)
    found = []
    for _ in range(2):
        stage.build()
        model.accelerate(stage.particles, stage.wall, stage.neighbors, (0.0, 0.0, 0.0))
        found.append([stage.in_order(f) for f in (
            stage.particles.acceleration, model.pressure_term, model.viscosity
        )])  # fmt: skip
        in_the_train(stage)
    for at_rest, moving in zip(*found, strict=True):
        assert_close(moving, at_rest, FRAME[precision()])


def test_features_in_a_moving_train_are_the_same(stage, surface):
    hold(stage, surface, AT, TURN, *MOTION)
    found = []
    for _ in range(2):
        stage.build()
        out = ndarray(float, (CAPACITY, ROW_COUNT))
        extract(stage.particles, stage.wall, stage.neighbors, THIN, SCALES, out)
        found.append(out.to_numpy()[: stage.particles.count[None]])
        in_the_train(stage)
    # Skewness and kurtosis of speeds jump where rounding moves a speed to the next bin.
    smooth = [k for k in range(ROW_COUNT) if k not in (SPEED_SKEWNESS, SPEED_KURTOSIS)]
    for k in smooth[3:]:
        assert_close(found[1][:, k], found[0][:, k], FRAME[precision()])


def test_divergence_feels_the_tool_come(stage, surface):
    """d(rho)/dt by brute force, proxies' own motion in it."""
    hold(stage, surface, AT, TURN, *MOTION)
    stage.build()
    out = ndarray(float, (CAPACITY, ROW_COUNT))
    extract(stage.particles, stage.wall, stage.neighbors, THIN, SCALES, out)
    found = out.to_numpy()[: stage.particles.count[None], 24] / -SCALES.frame_interval
    moving = brute_force(stage, THIN)
    rate = moving.spacing_volume * np.einsum("ija,ija->i", moving.grad, moving.v_ij)
    rate += THIN.calibration.wall_density * np.einsum(
        "ika,ika,k->i", moving.grad_wall, moving.v_ik, moving.volume
    )
    assert_close(found, rate, SUMS[precision()])


def force(stage: Setup, fluid, datum=(0.0, 0.0, 0.0, 0.0)) -> np.ndarray:
    """Of the blood on the tool, right after `accelerate` [N], (3,)."""
    found = force_on_tool(
        stage.particles, stage.wall, stage.neighbors, *make_model(fluid).pair_coefficients, *datum
    )
    return np.array([found[a] for a in range(3)])


def test_the_force_on_the_tool_is_minus_what_its_proxies_do_to_blood(stage, surface):
    hold(stage, surface, AT, TURN, *MOTION)
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
    stage, surface
):
    hold(stage, surface, AT, TURN, *MOTION)
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
                     model.stress, model.sound_speed, 0.0, 0.0, 0.0)  # fmt: skip
    taken = (with_tool - stage.in_order(stage.particles.acceleration)).sum(axis=0)
    # What a particle stands for is `Particles.mass`: so much blood rests on a tool at rest.
    mass = stage.particles.mass
    limit = SUMS[precision()] * mass * np.abs(with_tool).sum()
    np.testing.assert_allclose(found, -mass * taken, rtol=1e-6, atol=limit)


def test_a_datum_with_a_gradient_lifts_the_tool_by_what_it_displaces(stage, surface):
    stage.accelerate(BLOOD)
    at_rest = force(stage, BLOOD)
    displaced = enclosed_volume(surface.vertices, surface.faces)
    blood = BloodFlow(stage.particles, stage.wall, stage.neighbors, (0.0, 0.0, 0.0))
    for axis in range(3):
        slope = 1e4 * np.eye(3)[axis]
        blood.datum = Datum(7e3, tuple(slope), 1.0)
        tool = Tool(blood, None, np.zeros(3))
        lifted = force(stage, BLOOD, tool._datum()) - at_rest
        # A ball of two spacings in blood that has not settled.
        np.testing.assert_allclose(
            lifted, -displaced * slope, rtol=0, atol=0.25 * displaced * slope.max()
        )
