"""What every acceleration model must hold, whatever it computes: physics, network or stand-in."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from app.studies.methods import Ballistic, Stretched
from builders import CAPACITY, SPHERE, D, R, Setup, ball, float_dtype, make_fluid, precision, sphere
from clouds import SCALES
from nn.features import NAMES, NETWORK_COUNT, PAPER_COUNT, FeatureScales
from nn.pcnet import make_pcnet
from nn.weights import Training, Weights
from taichi_sph.diagnostics import viscosity_bounded
from taichi_sph.fluid.implicit import ImplicitAcceleration
from taichi_sph.fluid.model import AccelerationModel, Fluid
from taichi_sph.fluid.rheology import Casson
from taichi_sph.fluid.wcsph import SphAcceleration, sum_acceleration

RENUMBERED = {"f64": 1e-11, "f32": 2e-3}
"""Of the largest value: the same sums in another order; f32 loses two digits in compressions."""
FRAME = {"f64": 1e-9, "f32": 5e-3}
"""Of the largest value: velocities in another frame are rounded otherwise."""
TRAIN = np.array((0.4, -0.3, 0.2))
"""Velocity of a moving frame [m/s]: below what a network refuses as too fast."""
GRAVITY = (1.0, -2.0, -9.81)
FLUID = make_fluid(rheology=Casson(3.5e-3, 5e-3, 7.0), damping=1.0)
BINNED = ("alpha_dis_b", "alpha_rv_b", "beta_dis_b", "beta_rv_b", "alpha_dis_p", "beta_dis_p")
"""Features that jump where a value changes its bin; rounding may do that."""


def network(head: str) -> Weights:
    """Random weights of a small network without the features that jump."""
    generator = np.random.default_rng(3)
    names = NAMES[: PAPER_COUNT if head == "direct" else NETWORK_COUNT]
    inputs = tuple(name for name in names if name not in BINNED)
    layers = tuple(
        (
            generator.normal(size=(b, a)).astype(np.float32) / np.float32(np.sqrt(a)),
            generator.normal(size=b).astype(np.float32),
        )
        for a, b in pairwise((len(inputs), 5, 3))
    )
    training = Training(
        head=head, inputs=inputs, spacing=D, support_radius=R,
        frame_interval=SCALES.frame_interval, substeps=4, rounds=0,
        sound_speed=SCALES.sound_speed, wall_spacing_ratio=1.0, artificial_viscosity=0.0,
        viscosity_ratio=17.3, correction="bp", seed=0, scene="tube", scene_hash="0" * 64,
    )  # fmt: skip
    one = np.ones(len(inputs), np.float32)
    return Weights(layers, 0.0 * one, 0.5 * one, np.full(3, 0.3, np.float32), training)


@cache
def model_named(name: str) -> AccelerationModel:
    """One of each: its fields are compiled into its kernels."""
    return MODELS[name](FLUID, SCALES)


MODELS: dict[str, Callable[[Fluid, FeatureScales], AccelerationModel]] = {
    "physics": lambda fluid, _: SphAcceleration(fluid, CAPACITY),
    "nested physics": lambda fluid, _: SphAcceleration(replace(fluid, nested=True), CAPACITY),
    "implicit": lambda fluid, s: ImplicitAcceleration(fluid, CAPACITY, s.frame_interval),
    "direct head": lambda fluid, s: make_pcnet(
        network("direct"), fluid, s, CAPACITY, guarded=False
    ),
    "pressure head": lambda fluid, s: make_pcnet(network("pressure"), fluid, s, CAPACITY),
    "stretched": lambda fluid, _: Stretched(SphAcceleration(fluid, CAPACITY), 1.5),
    "ballistic": lambda fluid, _: Ballistic(fluid, CAPACITY),
}


def put(stage: Setup, x: np.ndarray, v: np.ndarray, names: np.ndarray | None = None) -> None:
    """Blood with a previous acceleration that depends on where it is, and no density yet."""
    stage.put(x, v, names)
    previous = np.zeros((CAPACITY, 3), float_dtype())
    previous[: len(x)] = 1e3 * np.roll(x, 1, axis=1)
    stage.particles.acceleration.from_numpy(previous)
    stage.particles.density.fill(-1.0)
    stage.particles.shifting.fill(math.nan)
    stage.build()


def accelerations(stage: Setup, model: AccelerationModel) -> np.ndarray:
    model.accelerate(stage.particles, stage.wall, stage.neighbors, GRAVITY)
    return stage.in_order(stage.particles.acceleration)


def blood(radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities [m/s] within a radius: a shear with noise."""
    generator = np.random.default_rng(15)
    x = ball(generator, radius)
    return x, np.roll(50.0 * x, 1, axis=1) + 0.03 * generator.normal(size=x.shape)


@pytest.fixture(params=MODELS)
def model(request: pytest.FixtureRequest) -> AccelerationModel:
    return model_named(request.param)


def assert_close(found: np.ndarray, expected: np.ndarray, relative: float) -> None:
    scale = np.abs(expected).max()
    assert scale > 0.0
    np.testing.assert_allclose(found, expected, rtol=0, atol=relative * scale)


def test_a_model_writes_finite_accelerations_and_densities_and_nothing_else(model):
    stage = sphere()
    put(stage, *blood(SPHERE - 0.2 * D))
    p, w = stage.particles, stage.wall
    fields = (p.position, p.velocity, p.identity, w.position, w.normal, w.volume)
    before = [f.to_numpy() for f in fields]
    a = accelerations(stage, model)
    assert np.isfinite(a).all() and np.abs(a).max() > 0.0
    density = stage.in_order(p.density)
    assert np.isfinite(density).all() and density.min() > 0.0
    assert np.isfinite(stage.in_order(p.shifting)).all()
    for field, values in zip(fields, before, strict=True):
        np.testing.assert_array_equal(field.to_numpy(), values)


@pytest.mark.parametrize(
    "name", ["physics", "nested physics", "implicit", "direct head", "pressure head"]
)
def test_every_model_shifts_particles_alike_but_for_its_step(name):
    stage, model = sphere(), model_named(name)
    put(stage, *blood(SPHERE - 0.2 * D))
    accelerations(stage, model)
    frequency = 1.0 / SCALES.frame_interval
    if "physics" in name:
        frequency = 1.0 / FLUID.step_limits(FLUID.sound_speed, 0.0, 0.0).sound
    expected = stage.reference(FLUID).shifting(FLUID.shifting, frequency)
    found = stage.in_order(stage.particles.shifting)
    assert_close(found, expected, {"f64": 1e-10, "f32": 2e-3}[precision()])


def test_a_model_gives_bitwise_the_same_twice(model):
    stage, state = sphere(), blood(SPHERE - 0.2 * D)
    put(stage, *state)
    first = accelerations(stage, model)
    put(stage, *state)
    np.testing.assert_array_equal(accelerations(stage, model), first)


def test_renumbering_the_particles_renumbers_a_models_accelerations(model):
    stage = sphere()
    x, v = blood(SPHERE - 0.2 * D)
    put(stage, x, v)
    before = accelerations(stage, model)
    names = np.random.default_rng(16).permutation(len(x))
    put(stage, x, v, names)
    assert_close(accelerations(stage, model)[names], before, RENUMBERED[precision()])


def test_blood_in_a_moving_train_accelerates_alike_under_a_model(model):
    stage = sphere()
    x, v = blood(SPHERE - 1.1 * R)  # out of the wall's reach, which does not move with it
    put(stage, x, v)
    at_rest = accelerations(stage, model)
    put(stage, x, v + TRAIN)
    assert_close(accelerations(stage, model), at_rest, FRAME[precision()])


def test_a_models_step_is_positive_and_no_longer_for_faster_blood(model):
    put(sphere(), *blood(SPHERE - 0.2 * D))
    accelerations(sphere(), model)
    steps = [model.stable_step(speed, 10.0) for speed in (0.0, 0.1, 1.0, 10.0, 100.0)]
    assert np.isfinite(steps).all() and min(steps) > 0.0
    assert steps == sorted(steps, reverse=True)


def test_a_model_says_what_it_is_and_what_its_forces_were_summed_from(model):
    stage = sphere()
    put(stage, *blood(SPHERE - 0.2 * D))
    found = accelerations(stage, model)
    assert model.name and not model.used_fallback
    if model.pair_coefficients is None:
        return
    fluid, pressure_term, viscosity, sound_speed = model.pair_coefficients
    assert sound_speed == model.sound_speed == FLUID.sound_speed
    if not fluid.nested:  # whose stress is in a field of its own
        physics = SphAcceleration(fluid, 1)
        sum_acceleration(
            stage.particles, stage.wall, stage.neighbors, fluid, pressure_term, viscosity,
            physics.stress, sound_speed, *GRAVITY,
        )  # fmt: skip
        np.testing.assert_array_equal(stage.in_order(stage.particles.acceleration), found)


@pytest.mark.parametrize("name", [*MODELS])
def test_a_model_at_another_sound_speed_is_the_one_that_is_made_for_it(name):
    stage, factor = sphere(), 1.7
    law = replace(FLUID.equation_of_state, sound_speed=factor * FLUID.sound_speed)
    fluid = replace(FLUID, equation_of_state=law)
    interval = SCALES.frame_interval / factor
    scales = replace(SCALES, frame_interval=interval, sound_speed=factor * SCALES.sound_speed)
    made, moved = MODELS[name](fluid, scales), MODELS[name](FLUID, SCALES)
    moved.sound_speed = fluid.sound_speed
    found = []
    for model in (made, moved):
        put(stage, *blood(SPHERE - 0.2 * D))
        found.append((accelerations(stage, model), stage.in_order(stage.particles.shifting)))
        assert model.stable_step(0.1, 1.0) == pytest.approx(made.stable_step(0.1, 1.0))
    for expected, other in zip(*found, strict=True):
        limit = {"f64": 1e-10, "f32": 2e-3}[precision()] * np.abs(expected).max()
        np.testing.assert_allclose(other, expected, rtol=0, atol=limit)
    put(stage, *blood(SPHERE - 0.2 * D))
    if name != "ballistic":
        before = accelerations(stage, model_named(name))
        assert np.abs(found[0][0] - before).max() > 1e-3 * np.abs(before).max()


def test_a_bound_of_viscosity_that_acts_is_counted():
    stage, count = sphere(), 0
    for longer, expected in ((1e-3, 0.0), (1e3, 1.0)):
        model = ImplicitAcceleration(FLUID, CAPACITY, longer * SCALES.frame_interval)
        put(stage, *blood(SPHERE - 0.2 * D))
        accelerations(stage, model)
        count = stage.particles.count[None]
        viscosity = stage.in_order(model.viscosity)
        assert viscosity.max() <= model.largest_viscosity * (1.0 + 1e-6)
        assert viscosity_bounded(model, count) == expected
    physics = model_named("physics")
    accelerations(stage, physics)
    assert viscosity_bounded(physics, count) == 0.0
