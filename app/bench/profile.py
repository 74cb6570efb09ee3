"""What each pass of a step costs, and how far it is from what the machine can do.

Two limits are measured on the same machine by loops of Taichi that do nothing else: products and
sums on vectors, and numbers fetched through the very lists that the passes go over.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import taichi as ti

from app.files import table
from nn.pcnet import PressurePcNet, load_pcnet
from nn.weights import Weights
from taichi_sph import Simulation, start
from taichi_sph.fluid.implicit import correct_pressure
from taichi_sph.fluid.wcsph import sum_acceleration, sum_density
from taichi_sph.integrator import kick_drift, largest_speed_and_acceleration
from taichi_sph.particles.neighbors import RUN, Neighbors
from taichi_sph.particles.particles import Particles
from taichi_sph.scene import Scene

if TYPE_CHECKING:
    from rich.table import Table

TURNS = 20
"""How often each pass is timed."""

DEPTH = 32
"""Products and sums in a row for each number of the arithmetic limit."""

WORK = {
    "physics: density, shear rate": (47, 7, 47, 5),
    "physics: forces": (54, 10, 46, 5),
    "PcNet: features and network": (60, 7, 37, 5),
    "PcNet: forces": (54, 10, 46, 5),
    "PcNet: correction": (31, 10, 23, 5),
}
"""A pass's operations and numbers fetched for each blood neighbour, and for each proxy.

Counted by hand from the kernels: a sum, product, quotient, root or comparison is one operation; the
index is a number too, and a list's entries beyond R count like all others.
"""
SEARCH = (9, 3)
"""The same for each candidate of the search; its coordinates follow in memory."""


@dataclass(frozen=True)
class Pass:
    """One pass over the particles of a scene, timed."""

    scene: str
    name: str
    milliseconds: float
    """Median."""
    pairs: int
    """Pairs or candidates that it goes over."""
    operations: float
    """Per second, floating-point; 0 where none are counted."""
    fetched: float
    """Numbers fetched per second."""


@dataclass(frozen=True)
class Limits:
    """What the machine reached in loops that do nothing else."""

    operations: float
    """Floating-point operations per second."""
    fetched: float
    """Numbers fetched through lists per second."""

    def best(self, other: "Limits") -> "Limits":
        """The higher of each."""
        return Limits(max(self.operations, other.operations), max(self.fetched, other.fetched))


@ti.kernel
def multiply_add(x: ti.template(), out: ti.template()):
    """DEPTH products and sums for each of two polynomials at each number."""
    for block in range(x.shape[0] // RUN):
        total = 0.0
        for lane in range(RUN):
            v = x[block * RUN + lane]
            s = v
            t = 1.0 - v
            for _ in ti.static(range(DEPTH)):
                s = s * v + 0.25
                t = t * v + 0.125
            total += s + t
        out[block] = total


@ti.kernel
def fetch(p: ti.template(), nb: ti.template(), out: ti.template()):
    """Sum of the six numbers of each neighbour's position and velocity."""
    for i in range(p.count[None]):
        total = ti.Vector([0.0, 0.0, 0.0])
        for n in range(nb.blood_count[i]):
            j = nb.blood_index[i, n]
            total += p.position[j] + p.velocity[j]
        out[i] = total.sum()


def candidates(particles: Particles, neighbors: Neighbors) -> int:
    """How many candidates the search tests: those in the runs of cells around each particle."""
    grid, n = neighbors.grid, particles.count[None]
    x = particles.position.to_numpy()[:n]
    cell = np.floor((x - np.array(grid.lower)) / np.array(grid.cell)).astype(int)
    first = neighbors.built.cell_start.to_numpy()[neighbors.rank.to_numpy()]
    below = np.maximum(cell - np.array(grid.reach), 0)
    above = np.minimum(cell + np.array(grid.reach), np.array(grid.shape) - 1)
    total = 0
    for dx in range(-grid.reach[0], grid.reach[0] + 1):
        for dy in range(-grid.reach[1], grid.reach[1] + 1):
            at = cell[:, :2] + (dx, dy)
            inside = (at >= below[:, :2]).all(axis=1) & (at <= above[:, :2]).all(axis=1)
            row = (at[:, 0] * grid.shape[1] + at[:, 1]) * grid.shape[2]
            here, there = row + below[:, 2], row + above[:, 2] + 1
            total += int((first[there[inside]] - first[here[inside]]).sum())
    return total


def _median(works: dict[str, Callable[[], Any]]) -> dict[str, float]:
    """Median seconds of each of some works, done in turn."""
    times: dict[str, list[float]] = {name: [] for name in works}
    for turn in range(1 + TURNS):
        for name, work in works.items():
            before = time.perf_counter()
            work()
            ti.sync()
            if turn:  # the first compiles
                times[name].append(time.perf_counter() - before)
    return {name: float(np.median(taken)) for name, taken in times.items()}


def measure_passes(
    scene: Scene, weights: Path, arch: str, threads: int | None
) -> tuple[list[Pass], Limits]:
    """Cost of each pass of a step, blood as it stands after 0.05 s of PcNet.

    The hidden layers' own cost is what they add to a network that has none.
    """
    start(arch, threads=threads)
    simulation = Simulation.from_scene(scene, load_pcnet(weights, scene))
    simulation.advance_to(0.05)
    net = simulation.model
    assert isinstance(net, PressurePcNet)
    implicit = net.implicit
    full = Weights.load(weights)
    flat = np.zeros((3, full.sizes[0]), np.float32), np.zeros(3, np.float32)
    p, w, nb = simulation.particles, simulation.wall, simulation.neighbors
    fluid = replace(simulation.fluid, nested=False)
    scratch = implicit.pressure_term, implicit.viscosity
    shallow = PressurePcNet(replace(full, layers=(flat,)), fluid, net.scales, p.capacity)
    more = implicit.stress, implicit.sound_speed, *scene.gravity
    numbers, sums = ti.field(float, 1 << 20), ti.field(float, max(p.capacity, (1 << 20) // RUN))
    seconds = _median({
        "neighbour search": lambda: nb.build(p, w),
        "physics: density, shear rate": lambda: sum_density(
            p, w, nb, fluid, *scratch, implicit.sound_speed
        ),
        "physics: forces": lambda: sum_acceleration(p, w, nb, fluid, *scratch, *more),
        "PcNet: features and network": lambda: net.estimate(p, w, nb, implicit),
        "PcNet: features, no hidden layer": lambda: shallow.estimate(p, w, nb, shallow.implicit),
        "PcNet: forces": lambda: sum_acceleration(p, w, nb, implicit.fluid, *scratch, *more),
        "PcNet: correction": lambda: correct_pressure(
            p, w, nb, implicit.fluid, implicit.interval, implicit.diagonal, implicit.pressure_term
        ),
        "survey": lambda: largest_speed_and_acceleration(p),
        "integration, wall": lambda: kick_drift(p, w, nb, None, False, 0.0, 0.0),
        "limit of arithmetic": lambda: multiply_add(numbers, sums),
        "limit of fetching": lambda: fetch(p, nb, sums),
    })  # fmt: skip
    n = p.count[None]
    blood = int(nb.blood_count.to_numpy()[:n].sum())
    walls = int(nb.wall_count.to_numpy()[:n].sum())
    limits = Limits(
        4.0 * DEPTH * numbers.shape[0] / seconds.pop("limit of arithmetic"),
        7.0 * blood / seconds.pop("limit of fetching"),
    )
    found = []
    for name, taken in seconds.items():
        pairs, operations, fetched = 0, 0.0, 0.0
        if name == "neighbour search":
            pairs = candidates(p, nb)
            operations, fetched = SEARCH[0] * pairs, SEARCH[1] * pairs
        elif name in WORK:
            per_blood, loads, per_proxy, wall_loads = WORK[name]
            pairs = blood + walls
            operations = per_blood * blood + per_proxy * walls
            fetched = loads * blood + wall_loads * walls
        found.append(
            Pass(scene.name, name, 1e3 * taken, pairs, operations / taken, fetched / taken)
        )
    return found, limits


def passes_table(passes: Sequence[Pass], limits: Limits) -> "Table":
    """Each pass beside the limits."""
    title = (
        f"passes of a step; limits here: {1e-9 * limits.operations:.1f} Gflop/s, "
        f"{1e-9 * limits.fetched:.2f} G numbers/s fetched through lists"
    )
    found = table(
        title, "scene", "pass", "ms", "M pairs/s", "Gflop/s", "of limit", "fetched G/s", "of limit"
    )
    for each in passes:
        cells = [""] * 5
        if each.pairs:
            cells = [
                f"{1e-3 * each.pairs / each.milliseconds:.0f}",
                f"{1e-9 * each.operations:.1f}",
                f"{each.operations / limits.operations:.0%}",
                f"{1e-9 * each.fetched:.2f}",
                f"{each.fetched / limits.fetched:.0%}",
            ]
        found.add_row(each.scene, each.name, f"{each.milliseconds:.2f}", *cells)
    return found


def draw(passes: Sequence[Pass], limits: Limits, path: Path) -> None:
    """Milliseconds of each pass beside the limits that each reaches, as a picture."""
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(each.name for each in passes))
    scenes = list(dict.fromkeys(each.scene for each in passes))
    figure = Figure(figsize=(11, 0.55 * len(names) + 1.4), layout="constrained")
    cost, share = figure.subplots(1, 2, sharey=True)
    height = 0.8 / len(scenes)
    for k, scene in enumerate(scenes):
        of_scene = {each.name: each for each in passes if each.scene == scene}
        at = np.arange(len(names)) + (k - 0.5 * (len(scenes) - 1)) * height
        cost.barh(
            at, [of_scene[name].milliseconds for name in names], height, label=scene, color=f"C{k}"
        )
        for y, name in zip(at, names, strict=True):
            each = of_scene[name]
            if each.pairs:
                arithmetic = 100.0 * each.operations / limits.operations
                fetching = 100.0 * each.fetched / limits.fetched
                share.plot([arithmetic], [y], "o", color=f"C{k}")
                share.plot([fetching], [y], "s", color=f"C{k}", mfc="none")
    cost.set_yticks(range(len(names)), names)
    cost.invert_yaxis()
    cost.set_xlabel("ms")
    cost.legend(title="scene", frameon=False)
    share.set_xlabel("% of the limit: ● arithmetic, □ numbers fetched through lists")
    share.set_xlim(0.0, None)
    for axes in (cost, share):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="x", alpha=0.3)
    figure.savefig(path, dpi=110)
