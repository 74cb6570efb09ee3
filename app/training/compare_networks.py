"""`vesselflow ladder`: from the paper's network to the default one, each rung measured alike.

A rung is an entry of RUNGS.  Each is trained on each dataset with several seeds; run 0 chooses the
weights, the last run, which nothing has looked at, gives the figures.
"""

import json
import multiprocessing
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from app.files import console, table, write_json
from nn.dataset.reader import Dataset
from nn.features import COUNT, NAMES
from nn.training.train import Settings, TrainingRuns, train_weights, use_threads
from nn.weights import CLIP, Weights
from taichi_sph.errors import InputError

Fit = Callable[[TrainingRuns, Settings], Weights]


@dataclass(frozen=True)
class Rung:
    """One kind of network."""

    name: str
    settings: Settings
    fit: Fit | None = None
    """Makes the weights without a training; `settings` then only says what they are."""


def linear(
    course: TrainingRuns, settings: Settings, matrix: np.ndarray, offset: np.ndarray
) -> Weights:
    """A direct network without hidden layers: a = matrix F + offset, both in R/T^2."""
    wide = 1e6 / CLIP  # nothing is clipped
    return Weights(
        ((matrix.astype(np.float32), (offset / wide).astype(np.float32)),),
        np.zeros(COUNT, np.float32),
        np.full(COUNT, wide, np.float32),
        np.full(3, wide, np.float32),
        course.training(settings, ""),
    )


def persistence(course: TrainingRuns, settings: Settings) -> Weights:
    """a_i^{n+1} = a_i^n."""
    return linear(course, settings, np.eye(3, COUNT), np.zeros(3))


def ridge(course: TrainingRuns, settings: Settings) -> Weights:
    """Ridge regression of the target on the 23 features, by their own deviations."""
    features, target = course.examples(32)
    x = features[:, :COUNT].astype(np.float64)
    mean, deviation = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-3)
    z = (x - mean) / deviation
    y = target / course.scales.acceleration
    weight = np.linalg.solve(z.T @ z + 1e-3 * len(z) * np.eye(COUNT), z.T @ (y - y.mean(axis=0)))
    matrix = (weight / deviation[:, None]).T
    return linear(course, settings, matrix, y.mean(axis=0) - matrix @ mean)


DIRECT = Settings(head="direct")
RUNGS = (
    Rung("previous acceleration", replace(DIRECT, correction="none"), persistence),
    Rung("ridge, 23 features", replace(DIRECT, correction="none"), ridge),
    Rung("direct, bp", replace(DIRECT, correction="bp")),
    Rung("direct, periodic", replace(DIRECT, correction="periodic")),
    Rung("direct, relabel", replace(DIRECT, correction="relabel")),
    Rung("pressure, no input", Settings(inputs=())),
    Rung("pressure, bp", Settings(correction="bp")),
    Rung("pressure, relabel", Settings()),
    Rung("pressure, all 25 inputs", Settings(inputs=NAMES)),
    Rung("pressure, relabel, 1 round", Settings(rounds=1)),
    Rung("pressure, relabel, 2 rounds", Settings(rounds=2)),
)

GROUPS = {
    "acceleration": ("a_x", "a_y", "a_z"),
    "N": ("N",),
    "mean position": ("disx_b", "disy_b", "disz_b"),
    "mean velocity": ("rvx_b", "rvy_b", "rvz_b"),
    "spread of distances": ("D_dis_b",),
    "spread of speeds": ("D_rv_b",),
    "higher moments": ("alpha_dis_b", "alpha_rv_b", "beta_dis_b", "beta_rv_b"),
    "M": ("M",),
    "proxies' mean position": ("disx_p", "disy_p", "disz_p"),
    "proxies' moments": ("D_dis_p", "alpha_dis_p", "beta_dis_p"),
    "compression": ("compression",),
    "divergence": ("divergence",),
}
"""Features that are left out together."""
ABLATIONS = (
    Rung("pressure, all 25 inputs", Settings(inputs=NAMES)),
    *(
        Rung(f"all but {name}", Settings(inputs=tuple(n for n in NAMES if n not in group)))
        for name, group in GROUPS.items()
    ),
    Rung("pressure, relabel", Settings()),
    Rung("pressure, no input", Settings(inputs=())),
)
"""Rungs of `--ablate`."""
ORDER = list(dict.fromkeys(rung.name for rung in (*RUNGS, *ABLATIONS)))


@dataclass(frozen=True)
class Task:
    """One rung on one dataset with one seed."""

    data: Path
    rung: Rung
    seed: int
    iterations: int
    arch: str


def measure(task: Task) -> dict[str, Any]:
    """Train and roll out; needs a process of its own, since it starts Taichi."""
    from taichi_sph.runtime import start

    use_threads(1)
    start(task.arch, "f32", 1, random_seed=task.seed)
    rung = task.rung
    settings = replace(rung.settings, seed=task.seed, iterations=task.iterations)
    with Dataset(task.data) as file:
        last = len(file.runs) - 1
        course = TrainingRuns(file, [0, last])
        before = time.perf_counter()
        if rung.fit is None:
            with tempfile.TemporaryDirectory() as folder:
                out = Path(folder) / "weights.npz"
                weights, _ = train_weights(course, out, settings, report=_quiet)
        else:
            weights = rung.fit(course, settings)
        trained = time.perf_counter() - before
        run = course.held[-1]
        figures = course.rollout(course.pcnet(weights), run)
        return {
            "rung": rung.name,
            "data": task.data.name,
            "substeps": run.facts.substeps,
            "sound_speed": run.facts.sound_speed,
            "seed": task.seed,
            "training_seconds": trained,
            **figures,
        }


def _quiet(_: object) -> None:
    """Report nothing."""


def _read(out: Path, iterations: int) -> list[dict[str, Any]]:
    """Rows measured before.

    Raises:
        InputError: the file is not a ladder's, or of trainings of another length.
    """
    if not out.exists() or not out.stat().st_size:
        return []
    try:
        found = json.loads(out.read_text())
        rows, before = found["rows"], found["iterations"]
    except (ValueError, KeyError):
        raise InputError(
            f"--out {out}: not the figures of a ladder, or cut; name another"
        ) from None
    if before != iterations:
        raise InputError(
            f"--out {out}: holds trainings of {before} iterations, asked for are {iterations}; "
            "name another file, or ask for the same"
        )
    return rows


def main(
    data: list[Path],
    out: Path,
    seeds: int,
    iterations: int,
    ablate: bool,
    processes: int,
    plot: Path | None,
    arch: str,
) -> None:
    """Measure what is not yet in `out`, and print the table.

    Raises:
        InputError: a dataset cannot be read, or `out` holds something else.
    """
    for path in data:
        with Dataset(path):
            pass
    done = _read(out, iterations)
    there = {(row["data"], row["rung"], row["seed"]) for row in done}
    tasks = [
        Task(path, rung, seed, iterations, arch)
        for path in data
        for rung in (ABLATIONS if ablate else RUNGS)
        # What is fitted without chance needs no second seed.
        for seed in range(1 if rung.fit else seeds)
        if (path.name, rung.name, seed) not in there
    ]
    context = multiprocessing.get_context("spawn")
    # Taichi frees no field: a process for each task.
    with context.Pool(processes, maxtasksperchild=1) as pool:
        for row in pool.imap_unordered(measure, tasks):
            done.append(row)
            write_json(out, {"iterations": iterations, "rows": done})
            print(
                f"{row['data']}, {row['rung']}, seed {row['seed']}: "
                f"survived {row['survived']:.2f} ({len(done)} done)",
                file=sys.stderr,
            )
    lines = summarise(done)
    print_table(lines)
    if plot is not None:
        draw(lines, plot)


@dataclass(frozen=True)
class Line:
    """A rung on a dataset: medians over its seeds."""

    rung: str
    substeps: int
    sound_speed: float
    alive: int
    """Seeds that lived to the end."""
    seeds: int
    survived: float
    path_error: float
    drained_error: float
    compression_p99: float
    training_seconds: float


def summarise(rows: list[dict[str, Any]]) -> list[Line]:
    """A line for each rung and dataset, in the order of RUNGS."""
    lines = []
    keys = {(row["sound_speed"], row["substeps"], ORDER.index(row["rung"])) for row in rows}
    for sound_speed, substeps, k in sorted(keys):
        mine = [
            row
            for row in rows
            if (row["rung"], row["substeps"], row["sound_speed"])
            == (ORDER[k], substeps, sound_speed)
        ]

        def median(name: str, mine: list[dict[str, Any]] = mine) -> float:
            return statistics.median(row[name] for row in mine)

        lines.append(
            Line(
                ORDER[k],
                substeps,
                sound_speed,
                sum(row["survived"] == 1.0 for row in mine),
                len(mine),
                median("survived"),
                median("path_error"),
                median("drained_error"),
                median("compression_p99"),
                median("training_seconds"),
            )
        )
    return lines


def print_table(lines: list[Line]) -> None:
    """The ladder for people."""
    found = table(
        "rollouts on a run never seen: medians over seeds, up to a death",
        "rung", "c m/s", "M", "alive", "survived", "path", "drained", "p99", "training s",
    )  # fmt: skip
    for line in lines:
        found.add_row(
            line.rung,
            f"{line.sound_speed:.1f}",
            str(line.substeps),
            f"{line.alive}/{line.seeds}",
            f"{100 * line.survived:.0f} %",
            f"{100 * line.path_error:.1f} %",
            f"{100 * line.drained_error:.1f} %",
            f"{100 * line.compression_p99:.1f} %",
            f"{line.training_seconds:.0f}",
        )
    console().print(found)


def draw(lines: list[Line], path: Path) -> None:
    """Draw which rungs live, and how wrong those are that live, over M."""
    from matplotlib.figure import Figure

    names = [name for name in ORDER if any(line.rung == name for line in lines)]
    speeds = sorted({line.sound_speed for line in lines})
    columns = [
        (c, m) for c in speeds for m in sorted({x.substeps for x in lines if x.sound_speed == c})
    ]
    grid = np.full((len(names), len(columns)), np.nan)
    figure = Figure(figsize=(9.0, 1.2 + 0.31 * len(names)), layout="constrained")
    axes = figure.add_subplot()
    for line in lines:
        row, column = names.index(line.rung), columns.index((line.sound_speed, line.substeps))
        lives = line.alive == line.seeds
        worst = max(line.path_error, line.drained_error, line.compression_p99)
        grid[row, column] = 100.0 * max(0.0, 1.0 - 3.0 * worst) if lives else 0.0
        text = f"{100 * worst:.1f} %" if lives else f"dies at {100 * line.survived:.0f} %"
        axes.text(column, row, text, ha="center", va="center", fontsize=8)
    axes.imshow(grid, cmap="RdYlGn", vmin=0.0, vmax=100.0, aspect="auto", alpha=0.7)
    axes.set_yticks(range(len(names)), names)
    axes.set_xticks(range(len(columns)), [f"M = {m}\nc = {c:.3g} m/s" for c, m in columns])
    axes.set_title("largest error of a pour never seen (median of the seeds), or when it dies")
    figure.savefig(path, dpi=120)
