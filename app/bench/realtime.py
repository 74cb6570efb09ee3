"""`vesselflow bench --real-time`: how much blood these cores hold in real time, over flow speed.

The same blood is divided more and more finely.  What a step costs is measured at each size; how
long a step may be follows from the flow's largest speed.  Gravity is what gives the blood that
speed: scaled by its square, a pour is the same but for the time that it takes.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from app.files import table
from app.scenes.library import varied, with_column
from nn.weights import Weights
from taichi_sph.derived import derive, expected_speed
from taichi_sph.errors import InputError
from taichi_sph.geometry.vessel import Vessel, read_vessel
from taichi_sph.scene import Scene

if TYPE_CHECKING:
    from rich.table import Table

SPEEDS = (0.05, 0.1, 0.2, 0.3, 0.5, 1.0)
"""Largest speed of the flow [m/s]: from a vein's to an artery's."""
COUNTS = (500, 1000, 2000, 4000, 8000, 16000)
"""Particles that the same blood is divided into."""


@dataclass(frozen=True)
class Curve:
    """One scene and model: cost over size, and the largest size in real time over speed."""

    scene: str
    model: str
    particles: tuple[int, ...]
    step_ms: tuple[float, ...]
    """Cost of a step of as many particles."""
    speed: tuple[float, ...]
    """[m/s]."""
    largest: tuple[float, ...]
    """Particles in real time at each speed; infinite where all sizes are."""


def divided(scene: Scene, particles: int) -> Scene:
    """The scene with its blood in so many particles."""
    spacing, column = scene.discretization.spacing, scene.column
    count = column.particles or read_vessel(scene).column_room(column, spacing).volume / spacing**3
    spacing *= (count / particles) ** (1.0 / 3.0)
    return with_column(varied(scene, None, spacing), particles, None)


def steps(scene: Scene, vessel: Vessel, weights: Weights, speed: float) -> tuple[float, float]:
    """Longest step of the physics and of PcNet [s] where blood reaches a speed [m/s]."""
    factor = (speed / expected_speed(scene, vessel)) ** 2
    gravity = tuple(factor * g for g in scene.gravity)
    d = derive(msgspec.structs.replace(scene, gravity=gravity), vessel, 0, 0)
    return d.step, weights.training.courant_number * d.support_radius / d.sound_speed


def largest_in_real_time(
    particles: Sequence[int], seconds: np.ndarray, longest: np.ndarray
) -> float:
    """Particles at which a step costs what it simulates, between sizes on a power law.

    Args:
        particles: sizes (n,), ascending.
        seconds: cost of a step at each size [s], (n,).
        longest: step at each size [s], (n,).

    Returns:
        infinity where the largest size is still faster; 0 where the smallest is too slow.
    """
    ratio = np.log(longest / seconds)
    if ratio[-1] >= 0.0:
        return math.inf
    if ratio[0] < 0.0:
        return 0.0
    k = int(np.flatnonzero(ratio < 0.0)[0])
    # From the size that is too slow down to that which is not: `interp` wants ascending ratios.
    between = np.interp(0.0, ratio[[k, k - 1]], np.log([particles[k], particles[k - 1]]))
    return float(np.exp(between))


def curves(
    scene: Scene, weights: Path, cost: Callable[[Scene], tuple[float, float]]
) -> list[Curve]:
    """The curve of each model.

    Args:
        scene: whose blood is divided.
        weights: of PcNet.
        cost: what a step of a scene costs the physics and PcNet [ms].

    Raises:
        InputError: the vessel is too narrow for every size.
    """
    learned = Weights.load(weights)
    sizes, scenes, vessels = [], [], []
    for n in COUNTS:
        each = divided(scene, n)
        try:
            vessels.append(read_vessel(each))
        except InputError:  # too coarse for the narrowest place
            if n == COUNTS[-1]:
                raise
            continue
        sizes.append(n)
        scenes.append(each)
    costs = np.array([cost(each) for each in scenes])
    longest = np.array([
        [steps(*each, learned, speed) for each in zip(scenes, vessels, strict=True)]
        for speed in SPEEDS
    ])  # fmt: skip
    return [
        Curve(
            scene.name, model, tuple(sizes), tuple(costs[:, side]), SPEEDS,
            tuple(
                largest_in_real_time(sizes, 1e-3 * costs[:, side], at_speed[:, side])
                for at_speed in longest
            ),
        )
        for side, model in enumerate(("physics", "pcnet"))
    ]  # fmt: skip


def _words(curve: Curve, largest: float) -> str:
    if math.isinf(largest):
        return f"> {curve.particles[-1]}"
    return f"{largest:.0f}" if largest else f"< {curve.particles[0]}"


def curves_table(found: Sequence[Curve]) -> "Table":
    """The largest size in real time, a row a scene and model, a column a speed."""
    rows = table(
        "blood particles in real time, by the flow's largest speed [m/s]",
        "scene", "model", *(f"{speed:g}" for speed in SPEEDS),
    )  # fmt: skip
    for curve in found:
        rows.add_row(curve.scene, curve.model, *(_words(curve, n) for n in curve.largest))
    return rows


def draw(found: Sequence[Curve], path: Path) -> None:
    """The curves as a picture."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 4.5), layout="constrained")
    axes = figure.subplots()
    scenes = list(dict.fromkeys(curve.scene for curve in found))
    for curve in found:
        largest = [min(n, COUNTS[-1]) if n else math.nan for n in curve.largest]
        axes.plot(
            curve.speed, largest, "o-" if curve.model == "pcnet" else "s--",
            color=f"C{scenes.index(curve.scene)}", label=f"{curve.scene}, {curve.model}",
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xticks(SPEEDS, [f"{speed:g}" for speed in SPEEDS])
    axes.set_yticks(COUNTS, [f"{n}" for n in COUNTS])
    axes.minorticks_off()
    axes.set_xlabel("largest speed of the flow [m/s]")
    axes.set_ylabel(f"blood particles in real time (at most {COUNTS[-1]} tried)")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=110)
