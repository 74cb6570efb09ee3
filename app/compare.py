"""`vesselflow compare`: models poured side by side, and how far each is from the physics.

All are stepped in turn, frame by frame, in one process: what else the machine does hits all alike.
The first frame of each, which compiles, is not timed.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from app.output import write_json
from app.progress import Progress
from nn.pcnet import load_pcnet
from taichi_sph.acceleration import SphAcceleration
from taichi_sph.diagnostics import FEW
from taichi_sph.errors import RunError
from taichi_sph.scene import Scene
from taichi_sph.simulation import Simulation
from taichi_sph.vessel import Vessel, read_vessel


@dataclass
class Contestant:
    """One model's run."""

    name: str
    simulation: Simulation
    seconds: list[float] = field(default_factory=list)
    """Wall time of each frame [s]."""
    drained: list[float] = field(default_factory=list)
    """Part of the blood that has left, at each frame."""
    centre: list[np.ndarray] = field(default_factory=list)
    """Centre of mass at each frame [m]; NaN of an empty vessel."""
    energy: list[float] = field(default_factory=list)
    """Kinetic energy at each frame [J]."""
    compression: list[float] = field(default_factory=list)
    """99th percentile at each frame."""
    compiled: int = 0
    """Steps of the first frame, which is not timed."""
    most_leaks: int = 0
    death: str = ""
    """Why it ended early."""

    def frame(self, until: float) -> None:
        """Advance to a time [s] and note how the blood stands; what has died stays so."""
        if self.death:
            return
        before = time.perf_counter()
        try:
            self.simulation.advance_to(until)
        except RunError as error:
            self.death = str(error)
            return
        self.seconds.append(time.perf_counter() - before)
        self.compiled = self.compiled or self.simulation.steps
        figures = self.simulation.diagnostics()
        x = self.simulation.positions()
        self.drained.append(1.0 - figures.particles / self.simulation.derived.blood_particles)
        self.centre.append(x.mean(axis=0) if len(x) else np.full(3, np.nan))
        self.energy.append(figures.kinetic_energy)
        self.compression.append(figures.compression_p99)
        self.most_leaks = max(self.most_leaks, figures.leaks)


@dataclass(frozen=True)
class Result:
    """How a contestant did; errors are against the first one."""

    name: str
    died: str
    """Empty if it did not."""
    steps: int
    milliseconds_per_step: float
    wall_per_simulated: float
    """Wall seconds for a simulated second."""
    speed_up: float
    """Of the first one's wall time over the same frames."""
    most_leaks: int
    wall_corrections: int
    fallback_share: float
    """Part of the simulated time for which the physics took over."""
    compression_p99: float
    """Largest of all frames."""
    path_error: float
    """Largest distance of the centres of mass over the length of the first one's path."""
    drained_error: float
    """Largest difference of the drained part."""
    half_drained: float
    """When half of the blood had left [s]; NaN if it never had."""
    energy_peak: float
    """Largest kinetic energy [J]."""


def result_of(one: Contestant, first: Contestant, frame_interval: float) -> Result:
    """Measure a contestant against the first."""
    frames = min(len(one.drained), len(first.drained))
    drained, reference = np.array(one.drained[:frames]), np.array(first.drained[:frames])
    centre, path = np.array(one.centre[:frames]), np.array(first.centre[:frames])
    together = np.maximum(drained, reference) < 1.0 - FEW
    length = np.linalg.norm(np.diff(path[together], axis=0), axis=1).sum()
    distance = np.linalg.norm(centre - path, axis=1)[together].max(initial=0.0)
    times = frame_interval * np.arange(1, frames + 1)
    simulation = one.simulation
    # The first frame compiles.
    wall = sum(one.seconds[1:])
    simulated = frame_interval * max(1, len(one.seconds) - 1)
    return Result(
        name=one.name,
        died=one.death,
        steps=simulation.steps,
        milliseconds_per_step=1e3 * wall / max(1, simulation.steps - one.compiled),
        wall_per_simulated=wall / simulated,
        speed_up=sum(first.seconds[1:frames]) / max(1e-9, sum(one.seconds[1:frames])),
        most_leaks=one.most_leaks,
        wall_corrections=simulation.wall_corrections,
        fallback_share=simulation.fallback_share,
        compression_p99=max(one.compression, default=0.0),
        path_error=float(distance / length) if length else 0.0,
        drained_error=float(np.abs(drained - reference).max(initial=0.0)),
        half_drained=(
            float(np.interp(0.5, drained, times)) if len(drained) and drained[-1] > 0.5 else np.nan
        ),
        energy_peak=max(one.energy, default=0.0),
    )


def contestants(
    scene: Scene, vessel: Vessel, weights: list[Path], soft: list[float], seed: int
) -> list[Contestant]:
    """The physics, networks, and the physics at lower sound speeds.

    Raises:
        InputError: weights that do not fit.
    """

    def stand(name: str, of: Scene, make: Callable[..., Any] = SphAcceleration) -> Contestant:
        return Contestant(name, Simulation(of, vessel, make, seed))

    runs = [stand("physics", scene)]
    for path in weights:
        name = "pcnet" if len(weights) == 1 else f"pcnet, {path.stem}"
        runs.append(stand(name, scene, load_pcnet(path, scene)))
    for ratio in soft:
        grid = msgspec.structs.replace(scene.discretization, sound_speed_ratio=ratio)
        softer = msgspec.structs.replace(scene, discretization=grid)
        runs.append(stand(f"physics, c = {ratio:g} U", softer))
    return runs


def compare(
    scene: Scene,
    weights: list[Path],
    soft: list[float],
    until: float,
    seed: int = 0,
    json_file: Path | None = None,
    plot: Path | None = None,
) -> list[Result]:
    """Pour a scene by every model to a time [s], or until all vessels are empty.

    Raises:
        InputError: weights that do not fit, or a column that does not.
    """
    runs = contestants(scene, read_vessel(scene), weights, soft, seed)
    interval = scene.frame_interval
    frames = max(1, round(until / interval))
    progress = Progress(frames * interval, scene.name)
    try:
        for frame in range(1, frames + 1):
            for run in runs:
                run.frame(frame * interval)
            progress.show(frame * interval, sum(run.simulation.steps for run in runs), 0)
            if all(run.death or run.drained[-1] == 1.0 for run in runs):
                break
    finally:
        progress.close()
    results = [result_of(run, runs[0], interval) for run in runs]
    if json_file is not None:
        write_json(json_file, as_json(scene, runs, results))
    if plot is not None:
        draw(scene, runs, plot)
    return results


def as_json(scene: Scene, runs: list[Contestant], results: list[Result]) -> dict[str, Any]:
    """Results and curves."""
    derived = runs[0].simulation.derived
    rows = []
    for run, result in zip(runs, results, strict=True):
        rows.append(asdict(result) | {"drained": run.drained, "compression": run.compression})
    return {
        "scene": scene.name,
        "blood_particles": derived.blood_particles,
        "proxy_particles": derived.proxy_particles,
        "frame_interval": scene.frame_interval,
        "results": rows,
    }


def print_results(scene: Scene, results: list[Result]) -> None:
    """A table for people."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"{scene.name}: against the physics")
    table.add_column("")
    for result in results:
        table.add_column(result.name, justify="right")
    rows: list[tuple[str, Callable[[Result], str]]] = [
        ("ended early", lambda r: "yes" if r.died else "no"),
        ("steps", lambda r: str(r.steps)),
        ("ms a step", lambda r: f"{r.milliseconds_per_step:.2f}"),
        ("wall s a simulated s", lambda r: f"{r.wall_per_simulated:.1f}"),
        ("speed-up", lambda r: f"{r.speed_up:.2f}"),
        ("leaks", lambda r: str(r.most_leaks)),
        ("wall corrections", lambda r: str(r.wall_corrections)),
        ("taken over by the physics", lambda r: f"{100 * r.fallback_share:.1f} %"),
        ("compression, 99th percentile", lambda r: f"{100 * r.compression_p99:.1f} %"),
        ("centre of mass, of its path", lambda r: f"{100 * r.path_error:.1f} %"),
        ("drained part, largest error", lambda r: f"{100 * r.drained_error:.1f} %"),
        ("half drained after [s]", lambda r: f"{r.half_drained:.4f}"),
        ("peak kinetic energy [mJ]", lambda r: f"{1e3 * r.energy_peak:.4g}"),
    ]
    for label, text in rows:
        table.add_row(label, *(text(result) for result in results))
    (Console() if sys.stdout.isatty() else Console(width=140)).print(table)
    for result in results:
        if result.died:
            print(f"{result.name}: {result.died}")


def draw(scene: Scene, runs: list[Contestant], path: Path) -> None:
    """Draw drained part and compression over time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for run in runs:
        times = scene.frame_interval * np.arange(len(run.drained) + 1)
        (line,) = left.plot(times, [0.0, *(100.0 * x for x in run.drained)], label=run.name)
        right.plot(
            times[1:], [100.0 * x for x in run.compression], color=line.get_color(), label=run.name
        )
        if run.death and run.drained:
            left.plot(times[-1], 100.0 * run.drained[-1], "x", color=line.get_color(), ms=9)
    left.set(xlabel="time [s]", ylabel="blood that has left [%]", title=scene.title)
    right.set(xlabel="time [s]", ylabel="compression, 99th percentile [%]", yscale="log")
    right.set_ylim(bottom=0.05)
    left.legend(frameon=False)
    figure.savefig(path, dpi=120)
