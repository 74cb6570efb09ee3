"""Cases of wall shear stress: steady and pulsating flow in a round tube."""

import cmath
import math

import numpy as np

from app.validation import analytic, flows
from app.validation.flows import DENSITY, VISCOSITY, Liquid
from app.validation.pipes import (
    PHASES,
    PULSES,
    RADIUS,
    WOMERSLEY,
    harmonic,
    parabola,
    pulsating_drive,
)
from app.validation.report import Report, relative_l2, watched
from taichi_sph.boundary.wall_stress import WallStress
from taichi_sph.simulation import Simulation

REYNOLDS = 100
"""Of the largest speed."""
SETTLED, WATCHED = 0.4, 0.1
"""Steady flow is watched so long, after so long [R^2/nu]."""


def watch_wall(motion: Simulation) -> WallStress:
    """Sum the friction on a tube's wall at the surface before each proxy."""
    wall, given = motion.wall, motion.wall.given
    feet = given.position - wall.setback * given.normal
    coefficients = motion.model.pair_coefficients
    assert coefficients is not None, "the physics sums its forces over pairs"
    measured = WallStress(motion.blood, coefficients[0], feet, given.normal)
    motion.boundaries = (*motion.boundaries, measured)
    return measured


def driven_tube(across: int, speed: float, drive: float) -> Simulation:
    """Disordered blood in a tube, at a closed scene's pressure and sound speed."""
    liquid = Liquid.closed(speed, 2.0 * RADIUS / across)
    return flows.tube(liquid, RADIUS, drive, ordered=False)


def wall_shear_stress(report: Report, quick: bool) -> None:
    """Wall shear stress of steady flow by resolution, and its amplitude and lag in a pulse."""
    resolutions = (10,) if quick else (10, 20, 40)
    work = [across**4 for across in resolutions]
    nu = VISCOSITY / DENSITY
    diffusion = RADIUS**2 / nu
    speed = REYNOLDS * nu / (2.0 * RADIUS)
    drive = 4.0 * VISCOSITY * speed / RADIUS**2
    theory = 0.5 * drive * RADIUS
    for number, across in enumerate(resolutions):
        motion = driven_tube(across, speed, drive)
        flows.set_velocity(motion, lambda x: parabola(x, speed))
        begin, end = (0.9 * sum(work[:j]) / sum(work) for j in (number, number + 1))
        times = [SETTLED * diffusion, (SETTLED + WATCHED) * diffusion]
        for k in watched(motion, times, report, begin, end):
            if k == 0:
                measured = watch_wall(motion)
        measured.look()
        result = measured.result()
        along = result.mean[:, 2]
        mean = float(along.mean())
        report.add(
            f"Poiseuille at Re {REYNOLDS}, {across} across, disordered: wall shear stress (L2 over "
            f"places {relative_l2(along, np.full_like(along, theory)):.1%}, TAWSS "
            f"{result.tawss.mean():.4g} Pa)",
            f"{mean:.4g} Pa", f"{theory:.4g} Pa", abs(mean / theory - 1.0),
            0.1 if across < 20 else 0.05,
        )  # fmt: skip
    _pulse(report, 10 if quick else 20)


def _pulse(report: Report, across: int) -> None:
    nu = VISCOSITY / DENSITY
    frequency = nu * (WOMERSLEY / RADIUS) ** 2
    period = 2.0 * math.pi / frequency
    speed = REYNOLDS * nu / (2.0 * RADIUS)
    drive = pulsating_drive(speed, frequency)
    motion = driven_tube(across, speed, drive)
    measured = watch_wall(motion)
    times = [(k + 1) / PHASES * period for k in range(PULSES * PHASES)]
    stress = []
    for _ in watched(
        motion, times, report, 0.9, 1.0,
        lambda time: drive / DENSITY * math.cos(frequency * time),
    ):  # fmt: skip
        stress.append(float(measured.look()[:, 2].mean()))
    # Each is the average of the time before its own: half of it earlier.
    middle = np.array(times[-PHASES:]) - 0.5 * period / PHASES
    found = harmonic(middle, np.array(stress[-PHASES:]), frequency)
    exact = analytic.pipe_pulsation_wall_stress(RADIUS, drive, frequency, VISCOSITY, DENSITY)
    where = f"Womersley, Wo {WOMERSLEY:g}, Re {REYNOLDS}, {across} across, disordered"
    report.compare(
        f"{where}: amplitude of the wall shear stress", abs(found), abs(exact), 0.05, "Pa"
    )
    lag, lag_exact = -cmath.phase(found), -cmath.phase(exact)
    report.add(
        f"{where}: lag of the wall shear stress behind the force (error: radians)",
        f"{lag:.4f} rad", f"{lag_exact:.4f} rad", abs(lag - lag_exact), 0.05,
    )  # fmt: skip
