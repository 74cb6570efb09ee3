"""The loop of a run: advance, observe, report; and how it ends."""

import math
import signal
import statistics
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from types import FrameType
from typing import TYPE_CHECKING, Any, Protocol

from app.progress import Progress
from taichi_sph.errors import RunError

if TYPE_CHECKING:
    from taichi_sph.diagnostics import Diagnostics
    from taichi_sph.simulation import Simulation


class Observer(Protocol):
    """Something that looks at every frame."""

    def on_frame(self, simulation: "Simulation", frame: int, figures: "Diagnostics") -> None:
        """Take what is wanted of this frame; copies, for the state moves on."""

    def close(self, ending: str) -> bool | None:
        """Finish the output; `ending` is a sentence about how the run ended.

        Returns:
            True if it would hold up Python's exit: a viewer that does not answer does.
        """


@dataclass(frozen=True)
class Summary:
    """What is left to say about a run when it has ended."""

    scene: str
    model: str
    blood_particles: int
    """At the start."""
    proxy_particles: int
    steps: int
    frames: int
    """Frames after the initial state."""
    simulated_time: float
    """[s]"""
    wall_time: float
    """Of the loop, observers and compilation included [s]."""
    median_step_ms: float
    """Median over the frames of the time a step took, without observers [ms]."""
    real_time_factor: float
    """Simulated time over wall time."""
    leaks: int
    """At the last frame; `most_leaks` is the worst of all frames."""
    most_leaks: int
    wall_corrections: int
    """One for each step of a particle that the wall's last defence has acted on."""
    compression_p99: float
    """99th percentile of max(rho/rho_0 - 1, 0) at the last frame."""
    most_compression_p99: float
    kinetic_energy: float
    """[J]"""
    particles: int
    """Live at the end."""
    drained_volume: float
    """[m^3]"""
    drained: dict[str, int]
    """Particles that have left, by opening."""
    mean_age: dict[str, float]
    """Mean time that those have been in the vessel [s], by opening that something has left by."""
    added_volume: float
    """Blood that pumps and reservoirs have added [m^3]."""
    fallback_share: float
    """Part of the simulated time in which the model fell back to the physics."""
    most_viscosity_bounded: float
    """Largest part of the blood, of all frames, whose viscosity the model held at its bound."""
    diverged: bool
    ending: str


@dataclass(frozen=True)
class Outcome:
    """A summary, and what ended the run early, if anything did."""

    summary: Summary
    error: RunError | OSError | None = None
    signal: int | None = None
    stalled: tuple[Observer, ...] = ()
    """Observers that would hold up Python's exit."""

    @property
    def exit_code(self) -> int:
        """0 done, 1 diverged, 2 an output that cannot be written, 128 + the signal."""
        if self.error is not None:
            return 1 if isinstance(self.error, RunError) else 2
        return 128 + self.signal if self.signal else 0

    @property
    def as_json(self) -> dict[str, Any]:
        """The summary as a plain dictionary."""
        return asdict(self.summary)


class _Stop(BaseException):
    """Ctrl-C or SIGTERM came while the simulation was advancing."""

    def __init__(self, number: int):
        """`number` is the signal's."""
        super().__init__(number)
        self.signal = number


class _Signals:
    """SIGINT and SIGTERM as an orderly end; a second one ends at once."""

    def __init__(self) -> None:
        self.received: int | None = None
        self._interruptible = False

    def _handle(self, number: int, _: FrameType | None) -> None:
        self.received = number
        signal.signal(number, signal.SIG_DFL)
        if self._interruptible:
            raise _Stop(number)

    @contextmanager
    def caught(self) -> Iterator[None]:
        """Handle both signals meanwhile (Python allows it in the main thread only)."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {s: signal.signal(s, self._handle) for s in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    @contextmanager
    def interruptible(self) -> Iterator[None]:
        """A signal in here raises; elsewhere it waits, so that no output is cut in two."""
        if self.received is not None:
            raise _Stop(self.received)
        self._interruptible = True
        try:
            yield
        finally:
            self._interruptible = False


def frame_time(frame: int, frame_interval: float, until: float) -> float:
    """Simulated time of a frame [s]: a product, since sums drift; the last one is `until`."""
    time = frame * frame_interval
    # Half a millionth of a frame is rounding, not another frame.
    return until if time > until - 5e-7 * frame_interval else time


def drive(
    simulation: "Simulation",
    observers: Sequence[Observer],
    until: float,
    frame_interval: float,
    progress: Progress | None = None,
    frame: int = 0,
    before_step: Callable[[], None] | None = None,
) -> Outcome:
    """Run a simulation to a time, showing every frame to every observer.

    Args:
        simulation: at its start, or at the frame that it goes on from.
        observers: closed by the end of this, however the run ends.
        until: simulated time [s] to stop at; a vessel that has run empty ends it earlier.
        frame_interval: simulated time between frames [s].
        progress: where the state of the run is shown; nowhere if None.
        frame: number of the first frame.
        before_step: called before each step; an empty vessel then ends nothing.

    Returns:
        the summary; with the error of a run that diverged or could not write its output, or the
        signal that ended it.
    """
    signals, stopped = _Signals(), None
    error: RunError | OSError | None = None
    step_times: list[float] = []
    most_leaks, most_compression, most_bounded = 0, 0.0, 0.0
    began, first_time = time.perf_counter(), simulation.time
    with signals.caught():
        figures = simulation.diagnostics()
        steps = simulation.steps
        try:
            while True:
                most_leaks = max(most_leaks, figures.leaks)
                most_compression = max(most_compression, figures.compression_p99)
                most_bounded = max(most_bounded, figures.viscosity_bounded)
                for observer in observers:
                    observer.on_frame(simulation, frame, figures)
                if progress:
                    progress.show(figures.time, simulation.steps, figures.leaks)
                empty = figures.particles == 0 and before_step is None
                if figures.time >= until or empty:
                    break
                before = time.perf_counter()
                with signals.interruptible():
                    end = frame_time(frame + 1, frame_interval, until)
                    simulation.advance_to(end, before_step)
                took = time.perf_counter() - before
                if simulation.steps > steps:
                    step_times.append(took / (simulation.steps - steps))
                figures = simulation.diagnostics()
                steps = simulation.steps
                frame += 1
            empty = figures.particles == 0 and figures.time < until
            ending = "all blood has left the vessel" if empty else "finished"
        except _Stop as stop:
            stopped = stop.signal
            ending = f"stopped by {signal.Signals(stopped).name}"
        except (RunError, OSError) as caught:
            error, ending = caught, str(caught)
        except BaseException as unforeseen:
            for observer in observers:
                observer.close(f"failed: {unforeseen}")
            raise
        finally:
            if progress:
                progress.close()
        stalled, failed = _close(observers, ending)
        if failed is not None and error is None:
            error, ending = failed, str(failed)
    wall_time = time.perf_counter() - began
    summary = _summary_of(
        simulation, figures, step_times,
        steps=steps, frames=frame, wall_time=wall_time,
        real_time_factor=(figures.time - first_time) / wall_time,
        most_leaks=most_leaks, most_compression_p99=most_compression,
        most_viscosity_bounded=most_bounded,
        diverged=isinstance(error, RunError), ending=ending,
    )  # fmt: skip
    return Outcome(summary, error, stopped, tuple(stalled))


def _close(observers: Sequence[Observer], ending: str) -> tuple[list[Observer], OSError | None]:
    """Close all; those that would hold up Python's exit, and the first that could not write."""
    stalled, failed = [], None
    for observer in observers:
        try:
            if observer.close(ending):
                stalled.append(observer)
        except OSError as caught:
            failed = failed or caught
    return stalled, failed


def _summary_of(
    simulation: "Simulation", figures: "Diagnostics", step_times: list[float], **counted: Any
) -> Summary:
    """The summary of a run that stands at its last frame, with what its loop has counted."""
    derived = simulation.derived
    return Summary(
        scene=simulation.scene.name,
        model=simulation.model.name,
        blood_particles=derived.blood_particles,
        proxy_particles=derived.proxy_particles,
        simulated_time=figures.time,
        median_step_ms=1e3 * statistics.median(step_times) if step_times else math.nan,
        leaks=figures.leaks,
        wall_corrections=figures.wall_corrections,
        compression_p99=figures.compression_p99,
        kinetic_energy=figures.kinetic_energy,
        particles=figures.particles,
        drained_volume=figures.drained_volume,
        drained=figures.drained,
        mean_age=figures.mean_age,
        added_volume=figures.added_volume,
        fallback_share=figures.fallback_share,
        **counted,
    )
