"""The lid-driven cavity: a closed square whose lid slides, against Ghia, Ghia and Shin 1982."""

import math

import numpy as np

from app.validation import flows
from app.validation.flows import DENSITY, VISCOSITY, Liquid, State, state_of
from app.validation.report import Curve, Report, watched
from taichi_sph.simulation import Simulation

SIDE = 1e-3
"""Of the square [m]."""
ACROSS = 40
"""Spacings across it."""
HEIGHT = np.array(
    [0.0625, 0.1719, 0.2813, 0.4531, 0.5, 0.6172, 0.7344, 0.8516, 0.9531, 0.9766]
)  # fmt: skip
ALONG = {
    100: np.array([-0.04192, -0.10150, -0.15662, -0.21090, -0.20581, -0.13641, 0.00332, 0.23151,
                   0.68717, 0.84123]),
    400: np.array([-0.09266, -0.24299, -0.32726, -0.17119, -0.11477, 0.02135, 0.16256, 0.29093,
                   0.55892, 0.75837]),
}  # fmt: skip
"""Speed along the lid on the upright centreline over the lid's, at HEIGHT over the side: table I of
doi:10.1016/0021-9991(82)90058-4."""
WIDTH = np.array([0.0625, 0.0938, 0.1563, 0.2344, 0.5, 0.8047, 0.8594, 0.9453, 0.9688])
UPRIGHT = {
    100: np.array([0.09233, 0.12317, 0.16077, 0.17527, 0.05454, -0.24533, -0.22445, -0.10313,
                   -0.05906]),
    400: np.array([0.18360, 0.22965, 0.28124, 0.30174, 0.05186, -0.38598, -0.44993, -0.22847,
                   -0.12146]),
}  # fmt: skip
"""Speed up the level centreline, at WIDTH: table II; its outlier at 0.9063, Re 400, left out."""
CASES = (
    (100, 12.0, 0.05),
    (400, 25.0, 0.08),
)
"""Reynolds number, time at the end [SIDE/U], tolerance of L2 over the points and their range."""
SAMPLES = 40
"""States that the last tenth of the time is averaged over."""


def lid_driven_cavity(report: Report, quick: bool) -> None:
    """Both centrelines of the steady flow, in a slab that is periodic sideways."""
    cases = CASES[:1] if quick else CASES
    across = ACROSS // 2 if quick else ACROSS
    total = sum(end for _, end, *_ in cases)
    done = 0.0
    for reynolds, end, tolerance in cases:
        speed = reynolds * VISCOSITY / (DENSITY * SIDE)
        motion = make_cavity(across, speed)
        times = SIDE / speed * end * np.linspace(0.9, 1.0, SAMPLES)
        found = np.zeros((2, 10)), np.zeros((2, 9))
        for _ in watched(motion, list(times), report, done / total, (done + end) / total):
            state = state_of(motion)
            found[0][:] += _sums(state, np.stack([0.5 + 0.0 * HEIGHT, HEIGHT], 1), 0, across)
            found[1][:] += _sums(state, np.stack([WIDTH, 0.5 + 0.0 * WIDTH], 1), 2, across)
        done += end
        for name, (above, below), place, table in (
            ("along the lid, upright centreline", found[0], HEIGHT, ALONG[reynolds]),
            ("up, level centreline", found[1], WIDTH, UPRIGHT[reynolds]),
        ):
            u = above / below / speed
            error = math.sqrt(np.square(u - table).mean()) / float(np.ptp(table))
            report.add(
                f"cavity, Re {reynolds}, {across} across: speed {name} (error: L2 over the range)",
                f"{u.min():.4f} to {u.max():.4f} U", f"{table.min():.4f} to {table.max():.4f} U",
                error, tolerance,
            )  # fmt: skip
            report.draw(
                f"cavity-{reynolds}", "place/side", "speed/U",
                Curve(name, place, u, place, table, "Ghia, Ghia and Shin 1982"),
            )  # fmt: skip


def _sums(state: State, places: np.ndarray, axis: int, across: int) -> np.ndarray:
    """Sums of W u and of W over the blood about places [SIDE], (2, k): their quotient is u."""
    radius = 1.5 / across
    x = state.position[:, [0, 2]] / SIDE
    q = np.linalg.norm(places[:, None] - x[None], axis=2) / radius
    weight = np.maximum(0.0, 1.0 - q) ** 4 * (4.0 * q + 1.0)
    return np.stack([weight @ state.velocity[:, axis], weight.sum(axis=1)])


def make_cavity(across: int, speed: float) -> Simulation:
    """Blood at rest in the square, whose lid slides along x at a speed [m/s]."""
    d = SIDE / across
    liquid = Liquid.closed(speed, d)
    setback = liquid.fluid().calibration.setback
    far = SIDE + setback
    count = round((SIDE + 2.0 * setback) / d)
    line = -setback + (np.arange(count) + 0.5) * (SIDE + 2.0 * setback) / count
    y = (np.arange(flows.SLAB) + 0.5) * d
    sides = []
    for level in (-setback, far):
        sides.append(np.stack(np.meshgrid(line, y, [level], indexing="ij"), -1).reshape(-1, 3))
    for level in (-setback, far):
        sides.append(np.stack(np.meshgrid([level], y, line, indexing="ij"), -1).reshape(-1, 3))
    normals = ((0, 0, -1), (0, 0, 1), (-1, 0, 0), (1, 0, 0))
    velocity = [np.zeros_like(side) for side in sides]
    velocity[1][:, 0] = speed
    reach = 2.0 * liquid.kernel.support_radius
    thick = flows.SLAB * d
    return flows.make_simulation(
        liquid, flows.lattice((across, flows.SLAB, across), d), None,
        np.concatenate(sides), np.repeat(np.array(normals, float), len(sides[0]), axis=0),
        (np.array([-reach, 0.0, -reach]), np.array([SIDE + reach, thick, SIDE + reach])),
        np.array([0.0, thick, 0.0]), wall_velocity=np.concatenate(velocity),
    )  # fmt: skip
