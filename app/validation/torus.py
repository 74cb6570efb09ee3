"""Flow in a bend: a closed torus, driven along it, with its secondary flow.

The resistance of a curved pipe over that of a straight one of the same flow rate goes with Dean's
number De = Re sqrt(a/R_c), a the radius of the pipe, R_c that of the bend:

    White:  1/(1 - (1 - (11.6/De)^0.45)^2.2)                 (1929, doi:10.1098/rspa.1929.0089)
    Ito:    21.5 De/(1.56 + log10 De)^5.73                   (1959, doi:10.1115/1.4008390)
"""

import math
from typing import Any

import numpy as np
import taichi as ti

from app.validation import flows
from app.validation.flows import DENSITY, VISCOSITY, Liquid, state_of
from app.validation.report import Report, watched
from taichi_sph.boundary.boundary import BloodFlow, Boundary
from taichi_sph.fluid.model import AccelerationModel
from taichi_sph.simulation import Simulation

RADIUS = 1e-3
"""Of the pipe a [m]."""
BEND = 5.0
"""Radius of the bend R_c over the pipe's."""
CASES = ((50, 10), (100, 10), (200, 10), (50, 16))
"""Dean's number, spacings across."""
WATCHED = 0.5
"""Time after which the flow is looked at [a^2/nu]."""


class DriveAlong(Boundary):
    """Acceleration g R_c/r along circles about z: a pressure that falls evenly with the angle."""

    name = "drive"

    def __init__(self, blood: BloodFlow, acceleration: float, bend: float):
        """G [m/s^2] at the radius R_c [m] of the bend."""
        self.blood, self.acceleration, self.bend = blood, acceleration, bend

    def before_drift(self, dt: float, model: AccelerationModel) -> float:
        """Add it to the accelerations."""
        accelerate_along(self.blood.particles, self.acceleration * self.bend)
        return 0.0

    def reset(self) -> None:
        """Nothing changes."""

    def save_state(self) -> dict[str, Any]:
        """Nothing changes."""
        return {}

    def load_state(self, saved: dict[str, Any]) -> None:
        """Nothing changes."""


@ti.kernel
def accelerate_along(p: ti.template(), strength: float):
    """Add strength/r along circles about z, r the distance from z.  Writes: acceleration."""
    for i in range(p.count[None]):
        x = p.position[i]
        r2 = x[0] * x[0] + x[1] * x[1]
        p.acceleration[i] += strength / r2 * ti.Vector([-x[1], x[0], 0.0])


def section(x: np.ndarray, bend: float) -> tuple[np.ndarray, np.ndarray]:
    """Distance r from z and distance from the pipe's axis [m] of points (n, 3), (n,) each."""
    r = np.hypot(x[:, 0], x[:, 1])
    return r, np.hypot(r - bend, x[:, 2])


def torus_wall(radius: float, bend: float, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Points about a spacing apart on a torus about z [m], and their normals, (n, 3) each."""
    points, normals = [], []
    around = round(2.0 * math.pi * radius / spacing)
    for row in range(around):
        angle = 2.0 * math.pi * row / around
        r = bend + radius * math.cos(angle)
        count = round(2.0 * math.pi * r / spacing)
        turn = 2.0 * math.pi * (np.arange(count) + 0.5 * (row % 2)) / count
        outward = np.column_stack(
            [math.cos(angle) * np.cos(turn), math.cos(angle) * np.sin(turn),
             np.full(count, math.sin(angle))]
        )  # fmt: skip
        centre = bend * np.column_stack([np.cos(turn), np.sin(turn), 0.0 * turn])
        points.append(centre + radius * outward)
        normals.append(outward)
    return np.concatenate(points), np.concatenate(normals)


def torus(liquid: Liquid, radius: float, bend: float, drive: float) -> Simulation:
    """A closed torus about z full of disordered blood, about to be driven by `drive` [Pa/m].

    One particle for every d^3 of it: a lattice that is cut to it, and the gaps at the wall filled
    at random.
    """
    d = liquid.spacing
    half, up = (math.ceil(size / d) for size in (bend + radius, radius))
    x = flows.lattice((2 * half, 2 * half, 2 * up), d) - [half * d, half * d, up * d]
    x = x[section(x, bend)[1] <= radius - 0.5 * d]
    missing = max(0, round(2.0 * math.pi**2 * bend * radius**2 / d**3) - len(x))
    generator = np.random.default_rng(0)
    away = np.sqrt(generator.uniform((radius - 1.5 * d) ** 2, (radius - 0.5 * d) ** 2, missing))
    angle, turn = generator.uniform(0.0, 2.0 * math.pi, (2, missing))
    r = bend + away * np.cos(angle)
    extra = np.column_stack([r * np.cos(turn), r * np.sin(turn), away * np.sin(angle)])
    setback = liquid.fluid().calibration.setback
    surface, normal = torus_wall(radius, bend, liquid.wall_spacing)
    reach = setback + liquid.kernel.support_radius
    corner = np.array([bend + radius + reach, bend + radius + reach, radius + reach])
    simulation = flows.make_simulation(
        liquid, np.concatenate([x, extra]), None, surface + setback * normal, normal,
        (-corner, corner), np.zeros(3),
    )  # fmt: skip
    flows.settle(simulation)
    drive_along = DriveAlong(simulation.blood, drive / DENSITY, bend)
    simulation.boundaries = (*simulation.boundaries, drive_along)
    return simulation


def white(dean: float) -> float:
    """Resistance of a bend over a straight pipe's, after White."""
    return 1.0 / (1.0 - (1.0 - (11.6 / dean) ** 0.45) ** 2.2)


def ito(dean: float) -> float:
    """Resistance of a bend over a straight pipe's, after Ito."""
    return 21.5 * dean / (1.56 + math.log10(dean)) ** 5.73


def bends(report: Report, quick: bool) -> None:
    """Resistance of a closed torus over that of a straight pipe, by Dean's number."""
    nu, bend = VISCOSITY / DENSITY, BEND * RADIUS
    cases = CASES[:1] if quick else CASES
    work = [dean * across**4 for dean, across in cases]
    for number, (dean, across) in enumerate(cases):
        mean = 0.5 * dean * math.sqrt(BEND) * nu / RADIUS
        expected = 0.5 * (white(dean) + ito(dean))
        drive = expected * 8.0 * VISCOSITY * mean / RADIUS**2
        largest = 2.0 * mean
        liquid = Liquid.closed(largest, 2.0 * RADIUS / across)
        motion = torus(liquid, RADIUS, bend, drive)

        def parabola(x: np.ndarray, speed: float = largest) -> np.ndarray:
            r, away = section(x, bend)
            along = np.column_stack([-x[:, 1], x[:, 0], 0.0 * r]) / r[:, None]
            return np.asarray((speed * (1.0 - (away / RADIUS) ** 2))[:, None] * along)

        flows.set_velocity(motion, parabola)
        begin, end = (sum(work[:j]) / sum(work) for j in (number, number + 1))
        for _ in watched(motion, [WATCHED * RADIUS**2 / nu], report, begin, end):
            state = state_of(motion)
        # Q = int u dA is the same at every angle: the mean over them is a sum over the volume.
        r, _ = section(state.position, bend)
        u = (state.position[:, 0] * state.velocity[:, 1]
             - state.position[:, 1] * state.velocity[:, 0]) / r  # fmt: skip
        volume = 2.0 * math.pi**2 * bend * RADIUS**2 / len(u)
        flow = float((volume * u / r).sum()) / (2.0 * math.pi)
        found = drive * math.pi * RADIUS**4 / (8.0 * VISCOSITY * flow)
        low, high = sorted((white(dean), ito(dean)))
        report.add(
            f"torus, De {dean}, {across} across: resistance over a straight pipe's (error: to the "
            "nearer of Ito and White)",
            f"{found:.3f}", f"{low:.3f} to {high:.3f}",
            max(0.0, low / found - 1.0, found / high - 1.0), 0.05,
        )  # fmt: skip
