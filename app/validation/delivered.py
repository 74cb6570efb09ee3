"""Delivered viscosity: what a shear wave feels in the settings of each shipped scene.

The spacing, the sound speed, the blood and the model are the scene's; only its vessel is left out.
A wave of 32 spacings at a speed that is usual in the scene decays in a periodic box whose particles
have been put out of order and have settled.
"""

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from app.models import MODELS, model_factory
from app.scenes.library import find_scene, shipped
from app.validation import analytic, flows
from app.validation.flows import Liquid, state_of
from app.validation.report import Report
from taichi_sph.derived import expected_speed
from taichi_sph.fluid.rheology import Casson, Newtonian
from taichi_sph.geometry.vessel import read_vessel
from taichi_sph.scene import Scene
from taichi_sph.simulation import Simulation

WAVE = 32
"""Length of the wave [spacings]."""
USUAL = 0.25
"""Speed of the wave over the largest that the scene's drive can give: most blood is that slow."""
DISORDER = 0.1
"""Random displacement before the particles settle [spacings]."""
TIME = 0.2
"""Watched for so long [decay times of the Newtonian wave], or until as much is gone."""
LOOKS = 10
"""Looks at the wave meanwhile."""
TOO_VISCOUS = "artificial viscosity, and the arrangement's resistance (docs/physics.md)"


def viscosity_law(rheology: Newtonian | Casson) -> Callable[[float], float]:
    """Viscosity [Pa s] at a shear rate [1/s]."""
    if isinstance(rheology, Casson):
        law = rheology
        return partial(analytic.regularised_casson, eta=law.eta, tau_y=law.tau_y, n=law.n)
    return lambda _: rheology.eta


def wave_of(scene: Scene, model: str) -> tuple[Simulation, Liquid, float, float]:
    """A wave in a scene's blood, under a model, its speed U [m/s] and its number k [1/m]."""
    vessel = read_vessel(scene)
    # As `taichi_sph.derived` has it: an arterial speed where nothing drives the blood.
    largest = expected_speed(scene, vessel) or 1.0
    liquid = Liquid.of_scene(scene, scene.discretization.sound_speed_ratio * largest)
    k, speed = 2.0 * math.pi / (WAVE * liquid.spacing), USUAL * largest

    def velocity(x: np.ndarray) -> np.ndarray:
        return np.column_stack([speed * np.sin(k * x[:, 2]), 0.0 * x[:, 0], 0.0 * x[:, 0]])

    motion = flows.box(liquid, (flows.SLAB, flows.SLAB, WAVE), velocity, DISORDER)
    make = model_factory(model, scene)
    motion.use_model(make(liquid.fluid(), motion.particles.capacity))
    return motion, liquid, speed, k


def amplitude(motion: Simulation, k: float) -> tuple[float, float]:
    """Amplitude of a wave [m/s], and the rms speed across it over that along it [-]."""
    state = state_of(motion)
    u, phase = state.velocity, k * state.position[:, 2]
    size = 2.0 * math.hypot((u[:, 0] * np.sin(phase)).mean(), (u[:, 0] * np.cos(phase)).mean())
    across = math.sqrt(np.square(u[:, 1:]).sum(axis=1).mean() / np.square(u[:, 0]).mean())
    return size, across


def delivered_viscosity(report: Report, quick: bool) -> None:
    """Viscosity that a wave feels in each shipped scene, by each model."""
    names = ["aortoiliac"] if quick else list(shipped())
    for number, (name, model) in enumerate((n, m) for n in names for m in MODELS):
        report.advance(number / (len(names) * len(MODELS)))
        scene = find_scene(name)
        motion, liquid, speed, k = wave_of(scene, model)
        law, density = viscosity_law(liquid.rheology), flows.DENSITY
        longest = TIME / analytic.shear_wave_rate(k, liquid.rheology.eta, density)
        begun, _ = amplitude(motion, k)
        left = 1.0
        for look in range(1, LOOKS + 1):
            motion.advance_to(longest * look / LOOKS)
            now, across = amplitude(motion, k)
            left = now / begun
            if left < math.exp(-TIME):
                break

        def viscosity(part: float, time: float = motion.time, k: float = k) -> float:
            """Of the Newtonian liquid that leaves such a part of the wave [Pa s]."""
            return -math.log(part) * flows.DENSITY / (k**2 * time)

        asked = viscosity(analytic.shear_wave_decay(k, speed, law, density, motion.time))
        found = viscosity(left)
        report.add(
            f"{name}, {model}: viscosity that a wave of {speed:.2g} m/s feels",
            f"{1e3 * found:.4g} mPa s; noise {across:.1%}", f"{1e3 * asked:.4g} mPa s",
            abs(found / asked - 1.0), 0.1, TOO_VISCOUS,
        )  # fmt: skip
