"""Cases of viscosity in blood without walls: a shear wave, Taylor and Green's vortices."""

import math

import numpy as np

from app.validation import analytic, flows
from app.validation.flows import DENSITY, MACH, VISCOSITY, Liquid, state_of
from app.validation.report import Report, watched
from taichi_sph.fluid.rheology import Newtonian

TOO_NARROW = "the default support radius of 2 d resolves vortices poorly (docs/physics.md)"
"""Why Taylor and Green's vortices are known to decay too fast in it."""


def shear_wave(report: Report, quick: bool) -> None:
    """Viscosity delivered to a wave of 32 spacings, by both viscous forms."""
    d, waves = 1e-4, 32
    nu = VISCOSITY / DENSITY
    k = 2.0 * math.pi / (waves * d)
    rate = analytic.shear_wave_rate(k, VISCOSITY, DENSITY)
    speed = 0.02 * d * rate  # so slow that the lattice stays one: the sum alone is judged

    def velocity(x: np.ndarray) -> np.ndarray:
        return np.column_stack([speed * np.sin(k * x[:, 2]), 0.0 * x[:, 0], 0.0 * x[:, 0]])

    for number, (form, nested) in enumerate((("pairwise", False), ("nested", True))):
        liquid = Liquid(Newtonian(VISCOSITY), 20.0 * nu / d, d, nested=nested)
        motion = flows.box(liquid, (flows.SLAB, flows.SLAB, waves), velocity)
        for _ in watched(motion, [1.0 / rate], report, number / 2, (number + 1) / 2):
            state = state_of(motion)
        amplitude = 2.0 * (state.velocity[:, 0] * np.sin(k * state.position[:, 2])).mean()
        delivered = -math.log(amplitude / speed) * VISCOSITY
        report.compare(
            f"shear wave, 32 d long, {form}: delivered viscosity",
            delivered * 1e3, VISCOSITY * 1e3, 0.05, "mPa s",
        )  # fmt: skip


def taylor_green(report: Report, quick: bool) -> None:
    """Energy decay of Taylor and Green's vortices, at the default and at a wider support."""
    n, reynolds, speed = 32, 10.0, 0.01
    nu = VISCOSITY / DENSITY
    length = reynolds * nu / speed
    rate = analytic.taylor_green_energy_rate(length, nu)

    def velocity(x: np.ndarray) -> np.ndarray:
        u, v = analytic.taylor_green(x[:, 0], x[:, 1], 0.0, length, speed, nu)
        return np.column_stack([u, v, 0.0 * u])

    for number, ratio in enumerate((2.0, 2.4)):
        liquid = Liquid(
            Newtonian(VISCOSITY), MACH * speed, length / n, support_ratio=ratio,
            # The vortices' own pressure falls to -rho U^2/2.
            background_pressure=0.6 * DENSITY * speed**2,
        )  # fmt: skip
        motion = flows.box(liquid, (n, n, flows.SLAB), velocity)
        energy = np.square(state_of(motion).velocity).sum()
        for _ in watched(motion, [1.0 / rate], report, number / 2, (number + 1) / 2):
            state = state_of(motion)
        measured = -math.log(np.square(state.velocity).sum() / energy) * rate
        report.compare(
            f"Taylor-Green, Re {reynolds:g}, 32 across, R = {ratio:g} d: decay of the energy",
            measured, rate, 0.05, "1/s", TOO_NARROW if ratio == 2.0 else "",
        )  # fmt: skip
