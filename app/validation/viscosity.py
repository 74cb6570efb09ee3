"""Cases of viscosity in blood without walls: a shear wave, Taylor and Green's vortices."""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from app.validation import analytic, flows
from app.validation.flows import DENSITY, MACH, VISCOSITY, Liquid, state_of
from app.validation.report import Report, watched
from taichi_sph.fluid.rheology import Newtonian
from taichi_sph.simulation import Simulation

SPEED = 0.01
"""U of the vortices [m/s]: as slow as one likes, since their Reynolds number is given."""
VORTEX_PRESSURE = 0.3
"""Background pressure of the vortices, whose own falls to -rho U^2/2 [rho U^2]: disordered
particles add some 0.6 of their own."""
TABULATED = (1.0, 2.0, 3.0, 5.0, 7.0, 10.0)
"""Times of TABLE_3D [1/(k U)]."""
TABLE_3D = {
    50: (0.11057, 0.09571, 0.08013, 0.05146, 0.03127, 0.01506),
    100: (0.11753, 0.10909, 0.09880, 0.07403, 0.04991, 0.02642),
}
"""Energies at them [U^2], by Reynolds number: references of jax-sph, where 1/8 is the first."""


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


def vortices(
    reynolds: float, across: int, solid: bool = False, **liquid: Any
) -> tuple[Simulation, float]:
    """Taylor and Green's vortices in disordered blood, in a plane or in three dimensions.

    Args:
        reynolds: U L/nu in a plane, of the width L of the periodic box; else U/(k nu), k = 2 pi/L.
        across: spacings in L.
        solid: in three dimensions.
        liquid: other settings of `Liquid` than the default ones.

    Returns:
        the flow, and k [1/m].
    """
    nu = VISCOSITY / DENSITY
    length = reynolds * nu / SPEED * (2.0 * math.pi if solid else 1.0)
    k = 2.0 * math.pi / length

    def velocity(x: np.ndarray) -> np.ndarray:
        u, v = analytic.taylor_green(x[:, 0], x[:, 1], 0.0, length, SPEED, nu)
        fade = np.cos(k * x[:, 2]) if solid else 1.0
        return np.column_stack([fade * u, fade * v, 0.0 * u])

    blood = replace(
        Liquid(
            Newtonian(VISCOSITY), MACH * SPEED, length / across,
            background_pressure=VORTEX_PRESSURE * DENSITY * SPEED**2,
        ),
        **liquid,
    )  # fmt: skip
    layers = across if solid else flows.SLAB
    return flows.box(blood, (across, across, layers), velocity, flows.DISORDER), k


def energy_of(motion: Simulation) -> float:
    """Sum of the squared speeds [m^2/s^2]."""
    return float(np.square(state_of(motion).velocity).sum())


def taylor_green(report: Report, quick: bool) -> None:
    """Energy decay of Taylor and Green's vortices in a plane, from disordered blood."""
    cases = ((100, 32),) if quick else ((10, 32), (100, 32), (400, 32), (100, 64))
    work = [across**3 * reynolds for reynolds, across in cases]
    for number, (reynolds, across) in enumerate(cases):
        motion, k = vortices(reynolds, across)
        rate = analytic.taylor_green_energy_rate(2.0 * math.pi / k, VISCOSITY / DENSITY)
        energy = energy_of(motion)
        begin, end = (sum(work[:j]) / sum(work) for j in (number, number + 1))
        for _ in watched(motion, [1.0 / rate], report, begin, end):
            measured = -math.log(energy_of(motion) / energy) * rate
        report.compare(
            f"Taylor-Green, Re {reynolds}, {across} across: decay of the energy",
            measured, rate, 0.05 if across > 32 else 0.1, "1/s",
            flows.RESISTING if reynolds > 100 or across > 32 else "",
        )  # fmt: skip


def taylor_green_3d(report: Report, quick: bool) -> None:
    """Energy of Taylor and Green's vortices in three dimensions, from disordered blood.

    Tabulated by jax-sph (validation/ref/tgv3d_ref_50.txt and _100.txt), for 1/k and U as units.
    """
    cases = ((50, 32),) if quick else ((50, 32), (100, 32), (100, 64))
    work = [across**4 for _, across in cases]
    for number, (reynolds, across) in enumerate(cases):
        motion, k = vortices(reynolds, across, solid=True)
        energy = energy_of(motion)
        times = [t / (k * SPEED) for t in TABULATED]
        begin, end = (sum(work[:j]) / sum(work) for j in (number, number + 1))
        found = [
            0.125 * energy_of(motion) / energy for _ in watched(motion, times, report, begin, end)
        ]
        table = TABLE_3D[reynolds]
        worst = max(range(len(table)), key=lambda j: abs(found[j] / table[j] - 1.0))
        report.add(
            f"Taylor-Green in three dimensions, Re {reynolds}, {across} across: energy at t = "
            f"{', '.join(f'{t:g}' for t in TABULATED)}, the worst at {TABULATED[worst]:g}",
            f"{found[worst]:.4f}", f"{table[worst]:.4f}",
            abs(found[worst] / table[worst] - 1.0), 0.1 if reynolds == 50 else 0.05,
            flows.RESISTING,
        )  # fmt: skip
