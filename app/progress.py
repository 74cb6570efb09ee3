"""How far a run is: a bar on a terminal, now and then a line elsewhere."""

import math
import sys
import time

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

LINE_EVERY = 5.0
"""Least wall time between two plain lines [s]."""


def duration(seconds: float) -> str:
    """Wall time for people: 42 s, 3 min 05 s, 2 h 10 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def make_bar(console: Console, transient: bool = False) -> Bar:
    """A bar with a title, a state in words and the time since it began, to be started."""
    return Bar(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.fields[state]}", markup=False),
        TimeElapsedColumn(),
        console=console,
        transient=transient,
    )


class Progress:
    """Simulated time, real-time factor and time left, on stderr."""

    def __init__(self, until: float, title: str, console: Console | None = None):
        """Show a run to a simulated time [s], which may be infinite."""
        self.until = until
        self._console = console or Console(file=sys.stderr, markup=False, emoji=False)
        self._reference: tuple[float, float] | None = None
        self._shown = -1e9
        self._bar: Bar | None = None
        if self._console.is_terminal:
            self._bar = make_bar(self._console)
            self._task = self._bar.add_task(
                title, total=until if math.isfinite(until) else None, state="compiling"
            )
            self._bar.start()

    def rate(self, simulated: float, now: float) -> float | None:
        """Simulated over wall time since the first frame, whose compilation does not count."""
        if self._reference is None:
            if simulated > 0.0:
                self._reference = (simulated, now)
            return None
        start, at = self._reference
        return (simulated - start) / (now - at) if now > at and simulated > start else None

    def show(self, simulated: float, steps: int, leaks: int) -> None:
        """Show a frame: simulated time [s], steps so far, leaks."""
        now = time.perf_counter()
        rate = self.rate(simulated, now)
        ends = math.isfinite(self.until)
        state = f"{simulated:.4f} {f'of {self.until:.4g} ' if ends else ''}s, {steps} steps"
        if rate:
            state += f", {rate:.3g} x real time"
        if rate and ends:
            state += f", {duration((self.until - simulated) / rate)} left"
        if leaks:
            state += f", {leaks} leak{'s' if leaks > 1 else ''}"
        if self._bar:
            self._bar.update(self._task, completed=simulated, state=state)
        elif now - self._shown >= LINE_EVERY and simulated < self.until:
            self._console.print(state, soft_wrap=True, highlight=False)
            self._shown = now

    def close(self) -> None:
        """Leave the terminal as it was."""
        if self._bar:
            self._bar.stop()
