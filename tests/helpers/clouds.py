"""Clouds of blood in the round vessel, and the features of them."""

import numpy as np
from taichi import ndarray

from builders import (
    SPHERE,
    WALL_SPACING,
    D,
    R,
    Setup,
    ball,
    float_dtype,
    make_fluid,
    sphere,
)
from nn.features import ROW_COUNT, FeatureScales, extract

SCALES = FeatureScales(R, D, 4e-4, 2.0, WALL_SPACING / D)
FLUID = make_fluid()


def cloud(seed: int) -> Setup:
    """Blood in the round vessel, up to its wall, with a few lone drops knocked out of it."""
    generator = np.random.default_rng(seed)
    x = ball(generator, SPHERE - 0.2 * D)
    x = x[generator.random(len(x)) < np.where(x[:, 2] > 0.0, 0.15, 1.0)]
    stage = sphere()
    v = 0.02 * generator.normal(size=x.shape) + np.roll(20.0 * x, 1, axis=1)
    stage.put(x, v)
    a = np.zeros((stage.particles.capacity, 3), float_dtype())
    a[: len(x)] = 50.0 * generator.normal(size=x.shape)
    stage.particles.acceleration.from_numpy(a)
    stage.build()
    return stage


def extracted(stage: Setup) -> np.ndarray:
    """What the kernel finds, by identity, (n, 27)."""
    out = ndarray(float, (stage.particles.capacity, ROW_COUNT))
    extract(stage.particles, stage.wall, stage.neighbors, FLUID, SCALES, out)
    return out.to_numpy()[: stage.particles.count[None]]
