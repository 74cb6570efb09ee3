"""`vesselflow train`: progress on the terminal, curves in files."""

import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from app.files import check_json, check_output, require_matplotlib, write_json
from app.progress import duration
from taichi_sph.errors import InputError

if TYPE_CHECKING:
    from nn.training.runs import Settings
    from nn.training.train import Progress


def require_torch(command: str) -> None:
    """Say which extra has torch, where it is missing."""
    if importlib.util.find_spec("torch") is None:
        raise InputError(f"{command}: torch is not installed; pip install 'vesselflow[train]'")


def check_plot(path: Path | None) -> None:
    """Refuse a picture that cannot be drawn or written; None asks for none."""
    if path is None:
        return
    require_matplotlib("--plot")
    check_output(path, "--plot", b"\x89PNG")


def train(
    data: Path,
    out: Path,
    settings: "Settings",
    held_out: Sequence[int],
    command: str,
    plot: Path | None,
    arch: str,
    threads: int | None,
) -> str:
    """Train, and say what came out; curves go to `out` with .history.json, and to `plot`.

    Raises:
        InputError: something given is of no use.
    """
    check_plot(plot)
    check_output(out, "--out", b"PK")
    curves = out.with_suffix(".history.json")
    check_json(curves, "--out", ("command", "validations"))

    from nn.dataset.reader import Dataset
    from nn.training.runs import TrainingRuns
    from nn.training.torch_network import use_threads
    from nn.training.train import train_weights
    from taichi_sph.runtime import start

    use_threads(threads)
    start(arch, "f32", threads, random_seed=settings.seed)

    def report(at: "Progress") -> None:
        left = at.seconds / at.iteration * (settings.iterations - at.iteration)
        figures = "  ".join(f"{name} {value:.3g}" for name, value in at.history[-1].items())
        print(f"{figures}  ({duration(at.seconds)}, {duration(left)} left)", file=sys.stderr)

    with Dataset(data) as file:
        weights, history = train_weights(
            TrainingRuns(file, held_out), out, settings, command, report
        )
    write_json(curves, {"command": command, "validations": history})
    if plot is not None:
        draw(history, plot)
    found = ", ".join(f"{name} {value:.3g}" for name, value in weights.training.validation.items())
    return f"{out}: {found}"


def draw(history: list[dict[str, float]], path: Path) -> None:
    """Draw the loss, and what rollouts on the held-out run got wrong, over gradient steps."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    steps = [row["iteration"] for row in history]
    left.plot(steps, [row["loss"] for row in history], "o-")
    left.set(xlabel="gradient step", ylabel="training loss (Huber)", yscale="log")
    for name, label in (
        ("path_error", "centre of mass, of its path"),
        ("drained_error", "drained fraction"),
        ("compression_p99", "compression, 99th percentile"),
    ):
        right.plot(steps, [1e2 * row[name] for row in history], "o-", label=label)
    for row in history:
        if row["survived"] < 1.0:
            right.annotate(f"died at {100 * row['survived']:.0f} %", (row["iteration"], 0.0))
    right.set(xlabel="gradient step", ylabel="rollout on the held-out run [%]", ylim=(0.0, None))
    right.legend(frameon=False)
    figure.savefig(path, dpi=120)
