"""Delivered viscosity: what a shear wave feels in the settings of each shipped scene.

The spacing, the sound speed, the blood and the model are the scene's; its vessel is left out: no
wall, no free surface.  A wave of 32 spacings at a speed that is usual in the scene decays in a
periodic box whose particles have been put out of order and have settled.

The pressure is the scene's too, for particles resist shear with a part of it: PRESSURE, and what
all open openings are held at; or CLOSED_PRESSURE over the datum.  A box has a volume, not a
pressure, and sheared particles need another volume than resting ones, by each model another.  So
the wave is watched again in wider or narrower boxes, until the mean pressure while it is watched is
what it should be, to within CLOSE; each row tells what it was.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from app.models import MODELS, model_factory
from app.scenes.library import find_scene, shipped
from app.validation import analytic, flows
from app.validation.flows import Liquid, state_of
from app.validation.report import Report
from taichi_sph.derived import derive
from taichi_sph.errors import InputError
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
"""Mean pressure where nothing drives the blood [rho u^2], u the speed of the wave: the blood of
aortoiliac has 0.01 to 0.11 rho u_rms^2 in its first 0.15 s by the physics and the implicit model,
and less than 0.001 later."""
CLOSED_PRESSURE = 0.3
"""Mean pressure over the datum in a closed vessel [rho U^2], so 4.8 rho u^2: `aorta_surgery` has
0.3 to 0.1 rho U^2 over 0.5 s, and 1 to 7 rho u_rms^2 once its flow has risen."""
CLOSE = 0.25
"""Largest error of the mean pressure."""
BOXES = 6
"""Most boxes that are tried by a model."""
RESPONSE = 200.0
"""Change of ln(pressure) with ln(density) that the second box is made from: some 170 in A; sound
alone, where all particles are under pressure, would be rho c^2/p, 2000."""
LARGEST_CHANGE = 0.015
"""Largest change of ln(density) from box to box."""
FAINTEST = 0.02
"""Least pressure that the next box is made from, over what is wanted: particles may be under none.
"""
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
    """A wave u_x = U sin(k z) in a scene's blood, in a box of a density."""

    motion: Simulation
    liquid: Liquid
    speed: float
    """U [m/s]."""
    number: float
    """k [1/m]."""
    settled: Floats
    """Positions that it begins from [m], (n, 3)."""
    wanted: float
    """Mean pressure that it should have [Pa]."""

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

    def denser(self, change: float) -> "Wave":
        """The same wave in a box of another ln(density), by so much more."""
        factor = math.exp(-change / 3.0)
        x, size = factor * self.settled, factor * np.asarray(self.motion.neighbors.grid.period)
        motion = flows.periodic(self.liquid, x, size)
        return replace(self, motion=motion, number=self.number / factor, settled=x)


def _sine(x: np.ndarray, speed: float, k: float) -> np.ndarray:
    return np.column_stack([speed * np.sin(k * x[:, 2]), 0.0 * x[:, 0], 0.0 * x[:, 0]])


def make_wave(scene: Scene) -> Wave:
    """The wave of a scene in a box of rest density: its particles out of order, and settled."""
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
    motion = flows.box(liquid, box, lambda x: _sine(x, speed, k), flows.DISORDER)
    return Wave(motion, liquid, speed, k, motion.positions().astype(float), pressure)


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


@dataclass(frozen=True)
class Decay:
    """What is seen of a wave by a model."""

    left: float
    """Part of the amplitude that is left [-]."""
    noise: float
    """Rms speed across the wave over that along it at the end [-]."""
    pressure: float
    """Mean while it was watched [Pa]."""


def watch(wave: Wave, make_model: ModelFactory) -> Decay:
    """Watch a wave from its beginning for TIME, or until as much of it is gone."""
    wave.begin(make_model)
    longest = TIME / analytic.shear_wave_rate(wave.number, wave.liquid.rheology.eta, flows.DENSITY)
    begun, noise = wave.amplitude()
    left, pressures = 1.0, []
    for look in range(1, LOOKS + 1):
        wave.motion.advance_to(longest * look / LOOKS)
        now, noise = wave.amplitude()
        left = now / begun
        pressures.append(wave.pressure())
        if left < math.exp(-TIME):
            break
    return Decay(left, noise, float(np.mean(pressures)))


def under_pressure(wave: Wave, make_model: ModelFactory) -> tuple[Wave, Decay]:
    """The wave in the box in which its mean pressure is what it should be, and what is seen of it.

    Boxes are chosen by the secant of ln(pressure) over ln(density); after BOXES of them the one
    that comes nearest is taken.
    """
    tried: list[tuple[float, Wave, Decay]] = []
    response, change = RESPONSE, 0.0
    while True:
        seen = watch(wave, make_model)
        off = math.log(max(seen.pressure / wave.wanted, FAINTEST))
        tried.append((off, wave, seen))
        if abs(seen.pressure / wave.wanted - 1.0) < CLOSE or len(tried) == BOXES:
            break
        if len(tried) > 1:
            found = (off - tried[-2][0]) / change
            response = min(max(found, 0.2 * RESPONSE), 10.0 * RESPONSE)
        change = min(max(-off / response, -LARGEST_CHANGE), LARGEST_CHANGE)
        wave = wave.denser(change)
    _, wave, seen = min(tried, key=lambda attempt: abs(attempt[0]))
    return wave, seen


def delivered_viscosity(report: Report, quick: bool) -> None:
    """Viscosity that a wave feels in each shipped scene, by each model."""
    names = ["aortoiliac"] if quick else list(shipped())
    for number, name in enumerate(names):
        scene = find_scene(name)
        wave = make_wave(scene)
        for part, model in enumerate(MODELS):
            report.advance((number + part / len(MODELS)) / len(names))
            try:
                wave, seen = under_pressure(wave, model_factory(model, scene))
            except InputError:
                continue  # the shipped weights refuse the scene's liquid, as they would in a run
            _add_row(report, f"{name}, {model}", wave, seen)


def _add_row(report: Report, case: str, wave: Wave, seen: Decay) -> None:
    """Hold the viscosity that a wave has felt against its law."""
    motion, k = wave.motion, wave.number

    def viscosity(part: float) -> float:
        """Of the Newtonian liquid that leaves such a part of the wave [Pa s]."""
        return -math.log(part) * flows.DENSITY / (k**2 * motion.time)

    law = viscosity_law(wave.liquid.rheology)
    asked = viscosity(analytic.shear_wave_decay(k, wave.speed, law, flows.DENSITY, motion.time))
    found = viscosity(seen.left)
    report.add(
        f"{case}: viscosity that a wave of {wave.speed:.2g} m/s feels",
        f"{1e3 * found:.4g} mPa s; noise {seen.noise:.1%}; {seen.pressure:.2g} Pa",
        f"{1e3 * asked:.4g} mPa s",
        abs(found / asked - 1.0), 0.1, flows.RESISTING,
    )  # fmt: skip
