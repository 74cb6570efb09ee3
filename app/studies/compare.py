"""`vesselflow compare`: models poured side by side, and how far each is from the physics.

All are stepped in turn, frame by frame, in one process: what else the machine does hits all alike.
The first frame of each, which compiles, is not timed.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from app.files import console, percent, table, write_json
from app.models import model_factory
from app.progress import Progress
from app.studies.timed_run import TimedRun, Trace, errors_of, require_falling
from taichi_sph.fluid.wcsph import SphAcceleration
from taichi_sph.geometry.vessel import Vessel, read_vessel
from taichi_sph.scene import Scene
from taichi_sph.simulation import Simulation


@dataclass(frozen=True)
class Result:
    """How a model did; errors are against the first one."""

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
    """Largest distance of the centres of mass over the length of the first one's path; NaN where
    the blood stays where it is."""
    drained_error: float
    """Largest difference of the drained part."""
    half_drained: float
    """When half of the blood had left [s]; NaN if it never had."""
    energy_peak: float
    """Largest kinetic energy [J]."""


def result_of(one: TimedRun, first: TimedRun) -> Result:
    """Measure a pour against the first."""
    errors = errors_of(one.trace, first.trace)
    frames = min(len(one.seconds), len(first.seconds))
    simulation = one.simulation
    return Result(
        name=one.name,
        died=one.failure,
        steps=simulation.steps,
        milliseconds_per_step=one.milliseconds_per_step,
        wall_per_simulated=one.wall_per_simulated,
        speed_up=sum(first.seconds[1:frames]) / max(1e-9, sum(one.seconds[1:frames])),
        most_leaks=one.most_leaks,
        wall_corrections=simulation.wall_corrections,
        fallback_share=simulation.fallback_share,
        compression_p99=errors.compression,
        path_error=errors.path,
        drained_error=errors.drained,
        half_drained=errors.half_drained,
        energy_peak=max(one.trace.energy, default=0.0)
        * simulation.derived.blood_particles
        * simulation.particles.mass,
    )


def make_runs(
    scene: Scene, vessel: Vessel, weights: list[Path], soft: list[float], seed: int
) -> list[TimedRun]:
    """The physics, the implicit model, networks, and the physics at lower sound speeds.

    Raises:
        InputError: weights that do not fit.
    """

    def add(name: str, of: Scene, make: Callable[..., Any] = SphAcceleration) -> TimedRun:
        simulation = Simulation.from_scene(of, make, seed, vessel)
        trace = Trace.of(scene)
        return TimedRun(name, simulation, trace)

    runs = [add(name, scene, model_factory(name, scene)) for name in ("physics", "implicit")]
    for path in weights:
        file = path.with_suffix("").as_posix()
        name = "pcnet" if len(weights) == 1 else f"pcnet, {'/'.join(file.split('/')[-2:])}"
        runs.append(add(name, scene, model_factory("pcnet", scene, path)))
    for ratio in soft:
        grid = msgspec.structs.replace(scene.discretization, sound_speed_ratio=ratio)
        softer = msgspec.structs.replace(scene, discretization=grid)
        runs.append(add(f"physics, c = {ratio:g} U", softer))
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
        InputError: weights that do not fit, a column that does not, or a scene that is driven.
    """
    require_falling(scene, "compare")
    runs = make_runs(scene, read_vessel(scene), weights, soft, seed)
    interval = scene.frame_interval
    frames = max(1, round(until / interval))
    progress = Progress(frames * interval, scene.name)
    try:
        for frame in range(1, frames + 1):
            for run in runs:
                run.frame(frame * interval)
            progress.show(frame * interval, sum(run.simulation.steps for run in runs), 0)
            if all(run.failure or run.empty for run in runs):
                break
    finally:
        progress.close()
    results = [result_of(run, runs[0]) for run in runs]
    if json_file is not None:
        write_json(json_file, as_json(scene, runs, results))
    if plot is not None:
        draw(scene, runs, plot)
    return results


def as_json(scene: Scene, runs: list[TimedRun], results: list[Result]) -> dict[str, Any]:
    """Results and curves."""
    derived = runs[0].simulation.derived
    rows = []
    for run, result in zip(runs, results, strict=True):
        rows.append(
            asdict(result) | {"drained": run.trace.drained, "compression": run.trace.compression}
        )
    return {
        "scene": scene.name,
        "blood_particles": derived.blood_particles,
        "proxy_particles": derived.proxy_particles,
        "frame_interval": scene.frame_interval,
        "results": rows,
    }


def print_results(scene: Scene, results: list[Result]) -> None:
    """A table for people."""
    names = [result.name for result in results]
    shown = table(f"{scene.name}: against the physics", "", *names)
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
        ("centre of mass, of its path", lambda r: percent(r.path_error)),
        ("drained part, largest error", lambda r: f"{100 * r.drained_error:.1f} %"),
        (
            "half drained after [s]",
            lambda r: f"{r.half_drained:.4f}" if math.isfinite(r.half_drained) else "never",
        ),
        ("peak kinetic energy [mJ]", lambda r: f"{1e3 * r.energy_peak:.4g}"),
    ]
    for label, text in rows:
        shown.add_row(label, *(text(result) for result in results))
    console().print(shown)
    for result in results:
        if result.died:
            print(f"{result.name}: {result.died}")


def draw(scene: Scene, runs: list[TimedRun], path: Path) -> None:
    """Draw drained part and compression over time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for run in runs:
        times = scene.frame_interval * np.arange(len(run.trace.drained) + 1)
        (line,) = left.plot(times, [0.0, *(100.0 * x for x in run.trace.drained)], label=run.name)
        right.plot(
            times[1:],
            [100.0 * x for x in run.trace.compression],
            color=line.get_color(),
            label=run.name,
        )
        if run.failure and run.trace.drained:
            left.plot(times[-1], 100.0 * run.trace.drained[-1], "x", color=line.get_color(), ms=9)
    left.set(xlabel="time [s]", ylabel="blood that has left [%]", title=scene.title)
    right.set(xlabel="time [s]", ylabel="compression, 99th percentile [%]", yscale="log")
    right.set_ylim(bottom=0.05)
    left.legend(frameon=False)
    figure.savefig(path, dpi=120)
