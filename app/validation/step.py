"""The backward-facing step: a plane channel that widens to twice its height, with its eddy.

Where the flow comes back to the lower wall is tabulated by Re = U 2h/nu, U the mean speed in the
channel before the step, whose height is h, as the step's is (Erturk 2008,
doi:10.1016/j.compfluid.2007.09.003).  After the wide channel the flow goes back into the narrow
one, so that it is periodic:

    z = 2h  _______________________________________________
             narrow |                             | narrow
    z = h   ________|            wide             |________
                    |                             |
    z = 0           |_____________________________|
                  x = 0
"""

import math
from typing import Any

import numpy as np
import taichi as ti

from app.validation import flows
from app.validation.flows import DENSITY, VISCOSITY, Liquid, State, state_of
from app.validation.report import Curve, Report, watched
from taichi_sph.boundary.boundary import BloodFlow, Boundary
from taichi_sph.errors import RunError
from taichi_sph.fluid.model import AccelerationModel
from taichi_sph.simulation import Simulation

HEIGHT = 1e-3
"""Of the step, and of the narrow channel, h [m]."""
NARROW = 10.0 * HEIGHT
"""Length of the narrow channel [m]: what comes into it is a parabola again after half of it."""
WIDE = 16.0 * HEIGHT
"""Length of the wide channel [m]."""
LENGTH = NARROW + WIDE
"""[m]"""
CASES = ((100, 10, 40.0, ""), (200, 10, 70.0, flows.RESISTING))
QUICK = ((100, 6, 30.0, flows.RESISTING),)
"""Reynolds number, spacings across the step, time at the end [h/U], known miss."""
REATTACHMENT = {100: 2.922, 200: 4.982}
"""Length of the eddy by Re [h]: table of Erturk 2008."""
AVERAGED = 20.0
"""Time at the end that is averaged over [h/U]."""
LOOKS = 80
"""States in it."""
SPREAD = 6.0 * HEIGHT
"""Length over which the flow widens at the start [m]."""
WIDE_DRIVE = 0.125
"""Drive of the wide channel over the narrow one's: of two parabolas of one flow rate."""
RESPONSE = 0.1
"""Time in which the drive makes up for a wrong flow rate [h/U]."""
EDGE = 0.43
"""Where the proxies' lines end before the step's edge [spacings]: the density of a lattice is then
0.99 to 1.01 of rho_0 there."""
NEAR = 3.0
"""What the shear rate at the wall is found from is nearer to it [spacings]."""
BIN = 0.2 * HEIGHT
"""Length of wall that has one shear rate [m]."""
LOOKED_AT = 0.75
"""Part of the wide channel in which the flow may come back to the wall."""


class HoldFlow(Boundary):
    """A drive along x that holds the flow rate, whatever the walls take.

    Each channel is driven as its parabola asks for, so that pressure changes at the step only.
    """

    name = "drive"

    def __init__(self, blood: BloodFlow, speed: float):
        """The mean speed U in the narrow channel [m/s]."""
        self.blood, self.speed = blood, speed

    def before_drift(self, dt: float, model: AccelerationModel) -> float:
        """Add it to the accelerations."""
        # The flow rate is the same at every x: its mean over them is a mean over the blood.
        mean = self.speed * LENGTH / (NARROW + 2.0 * WIDE)
        hold_mean(self.blood.particles, mean, RESPONSE * HEIGHT / self.speed)
        return 0.0

    def reset(self) -> None:
        """Nothing changes."""

    def save_state(self) -> dict[str, Any]:
        """Nothing changes."""
        return {}

    def load_state(self, saved: dict[str, Any]) -> None:
        """Nothing changes."""


@ti.func
def drive_at(x):
    """Drive at x [m] over the narrow channel's."""
    return ti.select(x > 0.0 and x < WIDE, WIDE_DRIVE, 1.0)


@ti.kernel
def hold_mean(p: ti.template(), mean: float, response: float):
    """Push along x, so that the mean speed goes to `mean` [m/s] within a time [s].

    Writes: acceleration.
    """
    missing, share = 0.0, 0.0
    for i in range(p.count[None]):
        missing += (mean - p.velocity[i][0]) / response - p.acceleration[i][0]
        share += drive_at(p.position[i][0])
    for i in range(p.count[None]):
        p.acceleration[i][0] += missing / share * drive_at(p.position[i][0])


def clearance(x: np.ndarray) -> np.ndarray:
    """How far points [m], (n, 3), are from the wall, or nearly so [m], (n,); in it less than 0."""
    below_roof = 2.0 * HEIGHT - x[:, 2]
    narrow = np.minimum(below_roof, x[:, 2] - HEIGHT)
    wide = np.minimum.reduce([below_roof, x[:, 2], x[:, 0], WIDE - x[:, 0]])
    return np.asarray(np.maximum(narrow, wide))


def disordered(spacing: float) -> np.ndarray:
    """Blood out of order [m], (n, 3), one particle for every d^3 of the room.

    The room begins and ends in the middle of the narrow channel.
    """
    d = spacing
    counts = (round(LENGTH / d), flows.SLAB, round(2.0 * HEIGHT / d))
    begin = np.array([-0.5 * NARROW, 0.0, 0.0])
    x = flows.lattice(counts, d) + begin
    x = x[clearance(x) > 0.0]
    generator = np.random.default_rng(0)
    moved, again = x.copy(), np.arange(len(x))
    while len(again):
        noise = generator.normal(size=(len(again), 3))
        moved[again] = x[again] + flows.DISORDER * d * noise
        again = again[clearance(moved[again]) < 0.5 * d * (1.0 - 1e-9)]
    return np.asarray(begin + (moved - begin) % [LENGTH, flows.SLAB * d, math.inf])


def walls(spacing: float, setback: float) -> tuple[np.ndarray, np.ndarray]:
    """Proxies a setback [m] behind the walls [m] and their normals, (m, 3) each."""
    half, edge = 0.5 * NARROW, EDGE * spacing
    roof = _line(-half, WIDE + half, spacing)
    before = _line(-half, -edge, spacing)
    after = _line(WIDE + edge, WIDE + half, spacing)
    floor = _line(-setback, WIDE + setback, spacing)
    side = _line(-setback, HEIGHT - edge, spacing)
    y = _line(0.0, flows.SLAB * spacing, spacing)
    sheets = (
        (roof, [2.0 * HEIGHT + setback], (0, 0, 1)),
        (np.concatenate([before, after]), [HEIGHT - setback], (0, 0, -1)),
        (floor, [-setback], (0, 0, -1)),
        ([-setback], side, (-1, 0, 0)),
        ([WIDE + setback], side, (1, 0, 0)),
    )
    points = [np.stack(np.meshgrid(x, y, z, indexing="ij"), -1).reshape(-1, 3)
              for x, z, _ in sheets]  # fmt: skip
    normals = [np.tile(np.array(n, float), (len(p), 1))
               for p, (*_, n) in zip(points, sheets, strict=True)]  # fmt: skip
    return np.concatenate(points), np.concatenate(normals)


def _line(begin: float, end: float, spacing: float) -> np.ndarray:
    """Middles of even parts of a line, nine to eight spacings, as `flows.plane_proxies`."""
    count = round(9.0 / 8.0 * (end - begin) / spacing)
    return begin + (np.arange(count) + 0.5) * (end - begin) / count


def start_velocity(x: np.ndarray, speed: float) -> np.ndarray:
    """Velocities [m/s] of the start at places [m], (n, 3) each.

    A parabola of a mean `speed` [m/s] in the narrow channel becomes one of half of it in the wide
    one; a stream function keeps the divergence zero.
    """
    z = x[:, 2] / HEIGHT
    stream, along = [], []
    for height, q in ((1.0, np.clip(z - 1.0, 0.0, 1.0)), (2.0, np.clip(0.5 * z, 0.0, 1.0))):
        stream.append(speed * HEIGHT * q**2 * (3.0 - 2.0 * q))
        along.append(speed / height * 6.0 * q * (1.0 - q))
    t = np.clip(np.minimum(x[:, 0], WIDE - x[:, 0]) / SPREAD, 0.0, 1.0)
    widened = t**2 * (3.0 - 2.0 * t)
    rate = np.sign(0.5 * WIDE - x[:, 0]) * 6.0 * t * (1.0 - t) / SPREAD
    u = along[0] + widened * (along[1] - along[0])
    return np.column_stack([u, 0.0 * u, (stream[0] - stream[1]) * rate])


def make_step(across: int, speed: float, settling: int = 500) -> Simulation:
    """Settled blood that flows over the step, `across` spacings high, at a mean speed U [m/s]."""
    d = HEIGHT / across
    liquid = flows.matched(Liquid.closed(1.5 * speed, d))
    reach, thick = 2.0 * liquid.kernel.support_radius, flows.SLAB * d
    simulation = flows.make_simulation(
        liquid, disordered(d), None, *walls(d, liquid.fluid().calibration.setback),
        (np.array([-0.5 * NARROW, 0.0, -reach]),
         np.array([WIDE + 0.5 * NARROW, thick, 2.0 * HEIGHT + reach])),
        np.array([LENGTH, thick, 0.0]),
    )  # fmt: skip
    flows.settle(simulation, settling)
    flows.set_velocity(simulation, lambda x: start_velocity(x, speed))
    simulation.boundaries = (*simulation.boundaries, HoldFlow(simulation.blood, speed))
    return simulation


def places() -> np.ndarray:
    """Middles of the parts of the lower wall that have a shear rate each [m], (k,)."""
    return (np.arange(round(LOOKED_AT * WIDE / BIN)) + 0.5) * BIN


def near_wall_sums(state: State, spacing: float) -> np.ndarray:
    """Sums of z^2, z^3, z^4, z u and z^2 u over the blood near the lower wall, (5, k)."""
    x, z = state.position[:, 0], state.position[:, 2]
    part = np.floor(x / BIN).astype(int)
    near = (z < NEAR * spacing) & (x > 0.0) & (part < len(places()))
    part, z, u = part[near], z[near], state.velocity[near, 0]
    terms = (z**2, z**3, z**4, z * u, z**2 * u)
    return np.stack([np.bincount(part, term, len(places())) for term in terms])


def shear_rate(sums: np.ndarray) -> np.ndarray:
    """Shear rate G at the wall [1/s], (k,): the least squares fit of u = G z + b z^2.

    Speed itself, beside the wall, changes its sign before the shear rate at the wall does.
    """
    z2, z3, z4, zu, z2u = sums
    return np.asarray((z4 * zu - z3 * z2u) / (z2 * z4 - z3**2))


def reattachment(place: np.ndarray, shear: np.ndarray) -> float:
    """Where shear rates change for good from backward to forward [m]; NaN if they do not."""
    turns = np.flatnonzero((shear[:-1] < 0.0) & (shear[1:] >= 0.0))
    if not len(turns) or shear[-1] < 0.0:
        return math.nan
    k = turns[-1]
    part = shear[k] / (shear[k] - shear[k + 1])
    return float(place[k] + part * (place[k + 1] - place[k]))


def backward_step(report: Report, quick: bool) -> None:
    """Length of the eddy behind the step."""
    cases = QUICK if quick else CASES
    done, total = 0.0, sum(end * across**4 for _, across, end, _ in cases)
    for reynolds, across, end, known in cases:
        d, theory = HEIGHT / across, REATTACHMENT[reynolds]
        speed = reynolds * VISCOSITY / (DENSITY * 2.0 * HEIGHT)
        motion = make_step(across, speed)
        work = end * across**4
        times = HEIGHT / speed * (end - AVERAGED * np.linspace(1.0, 0.0, LOOKS))
        sums, means = [], []
        for _ in watched(motion, list(times), report, done / total, (done + work) / total):
            state = state_of(motion)
            lost = int((clearance(state.position) < -0.5 * d).sum())
            if lost:
                raise RunError(f"step, Re {reynolds}: {lost} particles are deep in a wall")
            sums.append(near_wall_sums(state, d))
            narrow = (state.position[:, 0] < 0.0) | (state.position[:, 0] > WIDE)
            means.append(state.velocity[narrow, 0].mean())
        done += work
        shear = shear_rate(np.sum(sums, axis=0))
        found, first, last = (
            reattachment(places(), shear_rate(np.sum(part, axis=0))) / HEIGHT
            for part in (sums, sums[: LOOKS // 2], sums[LOOKS // 2 :])
        )
        reached = float(np.mean(means)) * 2.0 * HEIGHT * DENSITY / VISCOSITY
        report.add(
            f"backward-facing step, Re {reynolds} (reached {reached:.1f}), {across} across: "
            f"reattachment (error: step heights; still changing {abs(last - first):.2f})",
            f"{found:.3f} h", f"{theory:.3f} h", abs(found - theory), 0.3, known,
        )  # fmt: skip
        rate = shear * HEIGHT / speed
        report.draw(
            "step", "x/h", "shear rate at the lower wall, U/h",
            Curve(f"Re {reynolds}", places() / HEIGHT, rate,
                  np.array([theory, theory]), np.array([rate.min(), rate.max()]),
                  "reattachment, Erturk 2008"),
        )  # fmt: skip
