"""`vesselflow ladder`: from the paper's network to the default one, each variant measured alike.

A variant is an entry of VARIANTS.  Each is trained on each dataset with several seeds; run 0
chooses the weights, the last run, which nothing has looked at, gives the figures.
"""

import json
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from app.files import console, table, write_json
from app.jobs.process import report
from app.jobs.study import run_study
from nn.dataset.reader import Dataset
from nn.features import NAMES, PAPER_COUNT
from nn.training.runs import Settings, TrainingRuns
from nn.training.torch_network import use_threads
from nn.training.train import train_weights
from nn.weights import CLIP, Weights
from taichi_sph.errors import InputError

Fit = Callable[[TrainingRuns, Settings], Weights]


@dataclass(frozen=True)
class Variant:
    """One kind of network."""

    name: str
    settings: Settings
    fit: Fit | None = None
    """Makes the weights without a training; `settings` then only says what they are."""


def linear(
    runs: TrainingRuns, settings: Settings, matrix: np.ndarray, offset: np.ndarray
) -> Weights:
    """A direct network without hidden layers: a = matrix F + offset, both in R/T^2."""
    wide = 1e6 / CLIP  # nothing is clipped
    return Weights(
        ((matrix.astype(np.float32), (offset / wide).astype(np.float32)),),
        np.zeros(PAPER_COUNT, np.float32),
        np.full(PAPER_COUNT, wide, np.float32),
        np.full(3, wide, np.float32),
        runs.training(settings, ""),
    )


def persistence(runs: TrainingRuns, settings: Settings) -> Weights:
    """a_i^{n+1} = a_i^n."""
    return linear(runs, settings, np.eye(3, PAPER_COUNT), np.zeros(3))


def ridge(runs: TrainingRuns, settings: Settings) -> Weights:
    """Ridge regression of the target on the 23 features, by their own deviations."""
    features, target = runs.examples(32)
    x = features[:, :PAPER_COUNT].astype(np.float64)
    mean, deviation = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-3)
    z = (x - mean) / deviation
    y = target / runs.scales.acceleration
    weight = np.linalg.solve(
        z.T @ z + 1e-3 * len(z) * np.eye(PAPER_COUNT), z.T @ (y - y.mean(axis=0))
    )
    matrix = (weight / deviation[:, None]).T
    return linear(runs, settings, matrix, y.mean(axis=0) - matrix @ mean)


DIRECT = Settings(head="direct")
VARIANTS = (
    Variant("previous acceleration", replace(DIRECT, correction="none"), persistence),
    Variant("ridge, 23 features", replace(DIRECT, correction="none"), ridge),
    Variant("direct, bp", replace(DIRECT, correction="bp")),
    Variant("direct, periodic", replace(DIRECT, correction="periodic")),
    Variant("direct, relabel", replace(DIRECT, correction="relabel")),
    Variant("pressure, no input", Settings(inputs=())),
    Variant("pressure, bp", Settings(correction="bp")),
    Variant("pressure, relabel", Settings()),
    Variant("pressure, all 25 inputs", Settings(inputs=NAMES)),
    Variant("pressure, relabel, 1 round", Settings(rounds=1)),
    Variant("pressure, relabel, 2 rounds", Settings(rounds=2)),
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
    Variant("pressure, all 25 inputs", Settings(inputs=NAMES)),
    *(
        Variant(f"all but {name}", Settings(inputs=tuple(n for n in NAMES if n not in group)))
        for name, group in GROUPS.items()
    ),
    Variant("pressure, relabel", Settings()),
    Variant("pressure, no input", Settings(inputs=())),
)
"""Variants of `--ablate`."""
ORDER = list(dict.fromkeys(rung.name for rung in (*VARIANTS, *ABLATIONS)))


@dataclass(frozen=True)
class Row:
    """What a network did on a run that nothing had looked at."""

    rung: str
    """Name of the variant."""
    data: str
    substeps: int
    sound_speed: float
    """[m/s]"""
    seed: int
    training_seconds: float
    survived: float
    path_error: float
    drained_error: float
    compression_p99: float

    @property
    def key(self) -> tuple[str, str, int]:
        """Dataset, variant and seed."""
        return self.data, self.rung, self.seed


@dataclass(frozen=True)
class Job:
    """One variant on one dataset with one seed."""

    data: Path
    data_name: str
    """Name of the dataset, wherever it is read."""
    variant: str
    """Name of the variant: its functions stay here."""
    seed: int
    iterations: int
    arch: str

    @property
    def key(self) -> tuple[str, str, int]:
        """Dataset, variant and seed."""
        return self.data_name, self.variant, self.seed

    def __str__(self) -> str:
        return f"{self.data_name}, {self.variant}, seed {self.seed}"


def measure(job: Job) -> list[Row]:
    """Train and roll out; starts Taichi."""
    from taichi_sph.runtime import start

    use_threads(1)
    start(job.arch, "f32", 1, random_seed=job.seed)
    variant = next(v for v in (*VARIANTS, *ABLATIONS) if v.name == job.variant)
    settings = replace(variant.settings, seed=job.seed, iterations=job.iterations)
    with Dataset(job.data) as file:
        last = len(file.runs) - 1
        runs = TrainingRuns(file, [0, last])
        before = time.perf_counter()
        if variant.fit is None:
            with tempfile.TemporaryDirectory() as folder:
                out = Path(folder) / "weights.npz"
                weights, _ = train_weights(
                    runs, out, settings, report=lambda at: report(at.iteration / job.iterations)
                )
        else:
            weights = variant.fit(runs, settings)
        trained = time.perf_counter() - before
        run = runs.held[-1]
        figures = runs.rollout(runs.pcnet(weights), run)
        return [
            Row(
                rung=job.variant,
                data=job.data_name,
                substeps=run.facts.substeps,
                sound_speed=run.facts.sound_speed,
                seed=job.seed,
                training_seconds=trained,
                **figures,
            )
        ]


def read_figures(out: Path, iterations: int) -> list[Row]:
    """Rows measured before.

    Raises:
        InputError: the file is not a comparison's, or of trainings of another length.
    """
    if not out.exists() or not out.stat().st_size:
        return []
    try:
        found = json.loads(out.read_text(encoding="utf-8"))
        rows, before = msgspec.convert(found["rows"], list[Row]), found["iterations"]
    except (ValueError, KeyError, TypeError):
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
    scheduler: str | None = None,
) -> None:
    """Measure what is not yet in `out`, and print the table.

    Raises:
        InputError: a dataset cannot be read, or `out` holds something else.
        RunError: some could not be measured.
    """
    for path in data:
        with Dataset(path) as file:
            _ = file.runs[0].scene
    names = [path.name for path in data]
    if len(set(names)) < len(names):
        raise InputError(f"{', '.join(names)}: two datasets of one name; rename one")
    rows = read_figures(out, iterations)
    jobs = [
        Job(path, path.name, variant.name, seed, iterations, arch)
        for path in data
        for variant in (ABLATIONS if ablate else VARIANTS)
        # What is fitted without chance needs no second seed.
        for seed in range(1 if variant.fit else seeds)
    ]

    def save(found: list[Row]) -> None:
        write_json(out, {"iterations": iterations, "rows": [asdict(row) for row in found]})

    rows = run_study(rows, jobs, measure, save, tell, "ladder", processes, scheduler)
    lines = summarise(rows)
    print_table(lines)
    if plot is not None:
        draw(lines, plot)


def tell(rows: Sequence[Row]) -> str:
    """What came of a network."""
    (row,) = rows
    return f"{row.data}, {row.rung}, seed {row.seed}: survived {row.survived:.2f}"


@dataclass(frozen=True)
class Line:
    """A variant on a dataset: medians over its seeds."""

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


def summarise(rows: Sequence[Row]) -> list[Line]:
    """A line for each variant and dataset, in the order of VARIANTS."""
    lines = []
    keys = {(row.sound_speed, row.substeps, ORDER.index(row.rung)) for row in rows}
    for sound_speed, substeps, k in sorted(keys):
        mine = [
            row
            for row in rows
            if (row.rung, row.substeps, row.sound_speed) == (ORDER[k], substeps, sound_speed)
        ]

        def median(name: str, mine: list[Row] = mine) -> float:
            return statistics.median(getattr(row, name) for row in mine)

        lines.append(
            Line(
                ORDER[k],
                substeps,
                sound_speed,
                sum(row.survived == 1.0 for row in mine),
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
    """The comparison for people."""
    found = table(
        "rollouts on a run never seen: medians over seeds, up to a failure",
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
