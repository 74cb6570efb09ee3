"""What a run leaves and shows, one table for `run` and `replay`.

A new output is one entry of OUTPUTS: its option, its file, what may be replaced there, and the
observer that writes it.
"""

import contextlib
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from app.files import check_json, check_output, write_json
from app.locks import claimed
from app.run.checkpoint import Checkpointer
from app.run.loop import Observer, Outcome, Summary
from app.run.options import RunOptions
from app.run.wall_stress_file import BEGINNING, WallStressFile
from taichi_sph.errors import InputError
from taichi_sph.scene import Scene

if TYPE_CHECKING:
    from app.view.rerun_view import RerunView
    from taichi_sph.simulation import Simulation


@dataclass(frozen=True)
class Output:
    """A kind of output."""

    option: str
    file: Callable[[RunOptions, Scene], Path | None]
    """The file, where one is asked for."""
    check: Callable[[Path, str], None]
    """Raises InputError where the file must not be replaced."""
    observe: "Callable[[Simulation, RunOptions, dict[str, Any]], Observer | None] | None" = None
    """The observer that writes it, if one is asked for; None of a file that others write."""


def _begins(content: bytes) -> Callable[[Path, str], None]:
    return lambda path, option: check_output(path, option, content)


SUMMARY_KEYS = ("scene", "steps", "simulated_time", "ending")
"""What the first summaries had already."""


def _is_summary(path: Path, option: str) -> None:
    check_json(path, option, SUMMARY_KEYS)


def _view(
    simulation: "Simulation", options: RunOptions, facts: dict[str, Any]
) -> "RerunView | None":
    if options.rrd is None and options.live is None:
        return None
    from app.view.rerun_view import RerunView

    properties = {key: facts[key] for key in ("arch", "precision", "seed", "version")}
    view = RerunView(
        simulation, options.rrd, options.live, options.every, properties, options.checkpoint,
        options.colour,
    )  # fmt: skip
    if view.live:
        print(f"live view: rerun --connect {view.live.url}", file=sys.stderr)
    return view


def _checkpointer(
    simulation: "Simulation", options: RunOptions, facts: dict[str, Any]
) -> Checkpointer | None:
    path = options.checkpoint_file(simulation.scene)
    if path is None or options.checkpoint is None:
        return None
    return Checkpointer(path, options.checkpoint, facts)


def _wall_stress(
    simulation: "Simulation", options: RunOptions, facts: dict[str, Any]
) -> WallStressFile | None:
    return None if options.wall_stress is None else WallStressFile(simulation, options.wall_stress)


OUTPUTS = {
    "session": Output(
        "--session", RunOptions.session_file, _begins(b'{"format": "vesselflow session')
    ),
    "view": Output("--rrd", lambda options, _: options.rrd, _begins(b"RRF2"), _view),
    "wall_stress": Output(
        "--wall-stress", lambda options, _: options.wall_stress, _begins(BEGINNING), _wall_stress
    ),
    # Last of the observers: what came before it is safe by then.
    "checkpoint": Output("--checkpoint", RunOptions.checkpoint_file, _begins(b"PK"), _checkpointer),
    "summary": Output("--summary", lambda options, _: options.summary, _is_summary),
}
"""Outputs by name, in the order in which they see a frame.  The session is an observer too: who
makes it (`app.run_scene`, `app.control`) puts it first."""


@contextlib.contextmanager
def claimed_outputs(options: RunOptions, scene: Scene) -> Iterator[None]:
    """Check every file of a run, and keep other runs from writing it meanwhile.

    Raises:
        InputError: a file cannot be written, holds something else, or another run writes it.
    """
    if options.resume is not None and options.rrd is not None and _holds_something(options.rrd):
        raise InputError(f"--rrd {options.rrd}: holds the run so far; name another file")
    with contextlib.ExitStack() as claims:
        taken: dict[Path, str] = {}
        for output in OUTPUTS.values():
            path = output.file(options, scene)
            if path is None:
                continue
            output.check(path, output.option)
            first = taken.setdefault(path.resolve(), output.option)
            if first != output.option and not _is_device(path):
                raise InputError(f"{output.option} {path}: is the file of {first}; name another")
            claims.enter_context(claimed(path, output.option))
        yield


def _holds_something(path: Path) -> bool:
    return path.is_file() and path.stat().st_size > 0


def _is_device(path: Path) -> bool:
    return path.exists() and not path.is_file()


def observers_of(
    simulation: "Simulation", options: RunOptions, facts: dict[str, Any]
) -> dict[str, Observer]:
    """The observers that are asked for, by name, in their order.

    Raises:
        InputError: a file cannot be opened, or the port of the live view is taken.
    """
    made = {
        name: output.observe(simulation, options, facts)
        for name, output in OUTPUTS.items()
        if output.observe is not None
    }
    return {name: observer for name, observer in made.items() if observer is not None}


def quoted(path: Path) -> str:
    """A path as a command line takes it."""
    text = str(path)
    return subprocess.list2cmdline([text]) if sys.platform == "win32" else shlex.quote(text)


def report(outcome: Outcome, options: RunOptions) -> None:
    """Print how a run went, and write its summary.

    Raises:
        OSError: the summary cannot be written.
    """
    print(summary_text(outcome.summary))
    rrd = options.rrd
    if rrd is not None and not isinstance(outcome.error, OSError):
        size = rrd.stat().st_size / 1e6
        print(f"recording: {rrd} ({size:.1f} MB); see it with: rerun {quoted(rrd)}")
    if options.summary is not None:
        write_json(options.summary, outcome.as_json)


def _grouped(count: int) -> str:
    """A count with a space between thousands."""
    return f"{count:_}".replace("_", " ")


def summary_text(summary: Summary) -> str:
    """The summary of a run for people."""
    s = summary
    cost = "no frame was finished"
    if s.median_step_ms == s.median_step_ms:  # else NaN
        cost = f"{s.median_step_ms:.3g} ms a step (median)"
    blood = f"{s.particles} of {s.blood_particles} blood particles left"
    if s.added_volume > 0.0 or s.particles > s.blood_particles:
        blood = (
            f"{_grouped(s.particles)} blood particles (started with {_grouped(s.blood_particles)})"
        )
    lines = [
        f"{s.scene}: {s.ending}",
        f"  {s.simulated_time:.6g} s simulated in {s.frames} frames and {s.steps} steps",
        f"  {s.wall_time:.1f} s of wall time, {s.real_time_factor:.3g} x real time, {cost}",
        f"  {blood}, {1e6 * s.drained_volume:.3g} ml drained; {s.proxy_particles} proxies",
        f"  leaks {s.leaks} (most {s.most_leaks}), wall corrections {s.wall_corrections} "
        "(one for each step of a particle at the wall)",
        f"  compression {1e2 * s.compression_p99:.2f} % (99th percentile; "
        f"most {1e2 * s.most_compression_p99:.2f} %), kinetic energy {s.kinetic_energy:.3g} J",
    ]
    if len(s.drained) > 1:
        by_opening = ", ".join(f"{name} {count}" for name, count in s.drained.items())
        lines.insert(4, f"  particles drained: {by_opening}")
    if s.mean_age:
        by_opening = ", ".join(f"{name} {age:.3g} s" for name, age in s.mean_age.items())
        lines.append(f"  mean time in the vessel of what left: {by_opening}")
    if s.fallback_share:
        lines.append(f"  the physics took over for {1e2 * s.fallback_share:.2g} % of the time")
    if s.most_viscosity_bounded:
        lines.append(
            f"  viscosity was held at what the step of {s.model} bears in up to "
            f"{1e2 * s.most_viscosity_bounded:.2g} % of the blood: a shorter step shows it whole"
        )
    return "\n".join(lines)
