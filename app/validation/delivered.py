"""Delivered viscosity: what a shear wave feels in the settings of each shipped scene.

The spacing, the sound speed, the blood and the model are the scene's; its vessel is left out: no
wall, no free surface.  A wave of 32 spacings at a speed that is usual in the scene decays in a
periodic box whose particles have been put out of order and have settled.

The pressure is the scene's too, for particles resist shear with a part of it: PRESSURE, and what
all open openings are held at; or CLOSED_PRESSURE over the datum.  A box has a volume, not a
pressure, and sheared particles need another volume than resting ones: a first wave tells what
density they take in the box, and the box of the second has the volume that would give them the
pressure.  A closed box cannot give way: the noise of the wave raises the pressure again, so that
each row tells what it was at the end.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from app.models import MODELS, model_factory
from app.scenes.library import find_scene, shipped
from app.validation import analytic, flows
from app.validation.flows import Liquid, state_of
from app.validation.report import Report
from taichi_sph.derived import derive
from taichi_sph.fluid.rheology import Casson, Newtonian
from taichi_sph.geometry.mesh import Floats
from taichi_sph.geometry.vessel import read_vessel
from taichi_sph.scene import Scene
from taichi_sph.simulation import ModelFactory, Simulation
from taichi_sph.waveform import read_waveform

WAVE = 32
"""Length of the wave [spacings]."""
USUAL = 0.25
"""Speed of the wave over the U that the sound speed follows: most blood is that slow."""
PRESSURE = 0.05
"""Mean pressure where nothing drives the blood [rho U^2]: the blood of aortoiliac and A has 0.00
to 0.04 over their first 0.15 s, four fifths of it none at all."""
CLOSED_PRESSURE = 0.3
"""Mean pressure over the datum in a closed vessel [rho U^2]: 240 Pa in `aorta_surgery` by the
physics from 0.05 to 0.15 s, whose U is 0.83 m/s then."""
PROBE = 0.4
"""Time of the first wave over TIME."""
TIME = 0.05
"""Watched for so long [decay times of the Newtonian wave], or until as much is gone."""
LOOKS = 10
"""Looks at the wave meanwhile."""


def viscosity_law(rheology: Newtonian | Casson) -> Callable[[float], float]:
    """Viscosity [Pa s] at a shear rate [1/s]."""
    if isinstance(rheology, Casson):
        law = rheology
        return partial(analytic.regularised_casson, eta=law.eta, tau_y=law.tau_y, n=law.n)
    return lambda _: rheology.eta


@dataclass(frozen=True)
class Wave:
    """A wave u_x = U sin(k z) in a scene's blood."""

    motion: Simulation
    liquid: Liquid
    speed: float
    """U [m/s]."""
    number: float
    """k [1/m]."""
    settled: Floats
    """Positions that it begins from [m], (n, 3)."""

    def begin(self, make_model: ModelFactory) -> None:
        """Put the wave back to its beginning, under a model."""
        self.motion.use_model(make_model(self.liquid.fluid(), self.motion.particles.capacity))
        x = self.settled
        self.motion.restart_with(x, _sine(x, self.speed, self.number))

    def amplitude(self) -> tuple[float, float]:
        """Amplitude now [m/s], and the rms speed across the wave over that along it [-]."""
        state = state_of(self.motion)
        u, phase = state.velocity, self.number * state.position[:, 2]
        size = 2.0 * math.hypot((u[:, 0] * np.sin(phase)).mean(), (u[:, 0] * np.cos(phase)).mean())
        across = math.sqrt(np.square(u[:, 1:]).sum(axis=1).mean() / np.square(u[:, 0]).mean())
        return size, across

    def pressure(self) -> float:
        """Mean pressure of the last step [Pa]."""
        coefficients = self.motion.model.pair_coefficients
        assert coefficients is not None, "forces of every model here are summed over pairs"
        density = self.motion.particles.density.to_numpy()
        return float((coefficients[1].to_numpy() * density**2).mean())


def _sine(x: np.ndarray, speed: float, k: float) -> np.ndarray:
    return np.column_stack([speed * np.sin(k * x[:, 2]), 0.0 * x[:, 0], 0.0 * x[:, 0]])


def make_wave(scene: Scene) -> Wave:
    """The wave of a scene: its particles out of order, and settled."""
    derived, ratio = derive(scene, read_vessel(scene), 0, 0), scene.discretization.sound_speed_ratio
    if derived.quiet_speed is None:
        largest = derived.sound_speed / ratio
        pressure = PRESSURE * flows.DENSITY * (USUAL * largest) ** 2 + level_of(scene)
    else:
        largest = derived.quiet_speed
        pressure = CLOSED_PRESSURE * flows.DENSITY * largest**2
    liquid = Liquid.of_scene(scene, ratio * largest)
    k = 2.0 * math.pi / (WAVE * liquid.spacing)
    speed = USUAL * largest
    box = flows.SLAB, flows.SLAB, WAVE
    first = flows.box(liquid, box, lambda x: _sine(x, speed, k), flows.DISORDER)
    settled = first.positions().astype(float)
    decay = analytic.shear_wave_rate(k, liquid.rheology.eta, flows.DENSITY)
    first.advance_to(PROBE * TIME / decay)
    wanted = flows.DENSITY + pressure / liquid.sound_speed**2
    stretch = float(np.cbrt(state_of(first).density.mean() / wanted))
    second = flows.periodic(liquid, stretch * settled, stretch * liquid.spacing * np.asarray(box))
    return Wave(second, liquid, speed, k / stretch, stretch * settled)


def level_of(scene: Scene) -> float:
    """Pressure that all open openings are held at, the lowest in a beat [Pa]; 0 if one is not."""
    levels = [
        float((read_waveform(table.waveform, Path(scene.folder)).factor * table.pressure).min())
        if table.pressure is not None
        else 0.0
        for table in scene.openings.values()
        if table.state == "open" and table.flow is None
    ]
    return max(0.0, min(levels, default=0.0))


def delivered_viscosity(report: Report, quick: bool) -> None:
    """Viscosity that a wave feels in each shipped scene, by each model."""
    names = ["aortoiliac"] if quick else list(shipped())
    for number, name in enumerate(names):
        scene = find_scene(name)
        wave = make_wave(scene)
        for part, model in enumerate(MODELS):
            report.advance((number + part / len(MODELS)) / len(names))
            wave.begin(model_factory(model, scene))
            _add_row(report, f"{name}, {model}", wave)


def _add_row(report: Report, case: str, wave: Wave) -> None:
    """Watch a wave from its beginning, and hold the viscosity that it feels against its law."""
    motion, rheology, k = wave.motion, wave.liquid.rheology, wave.number
    longest = TIME / analytic.shear_wave_rate(k, rheology.eta, flows.DENSITY)
    begun, across = wave.amplitude()
    left = 1.0
    for look in range(1, LOOKS + 1):
        motion.advance_to(longest * look / LOOKS)
        now, across = wave.amplitude()
        left = now / begun
        if left < math.exp(-TIME):
            break

    def viscosity(part: float) -> float:
        """Of the Newtonian liquid that leaves such a part of the wave [Pa s]."""
        return -math.log(part) * flows.DENSITY / (k**2 * motion.time)

    law = viscosity_law(rheology)
    asked = viscosity(analytic.shear_wave_decay(k, wave.speed, law, flows.DENSITY, motion.time))
    found = viscosity(left)
    report.add(
        f"{case}: viscosity that a wave of {wave.speed:.2g} m/s feels",
        f"{1e3 * found:.4g} mPa s; noise {across:.1%}; {wave.pressure():.2g} Pa",
        f"{1e3 * asked:.4g} mPa s",
        abs(found / asked - 1.0), 0.1, flows.RESISTING,
    )  # fmt: skip
