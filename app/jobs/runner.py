"""Jobs: functions called in processes of their own, several at once, here or on a Dask cluster.

A process may be killed or crash: it is noticed, tried again, and then said in a sentence.
"""

import contextlib
import pickle
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from rich.console import Console
from rich.progress import Progress as Bar

from app.jobs.cluster import run_on_cluster
from app.jobs.process import ATTEMPTS, POLL, Event, Process, ProcessError
from app.progress import LINE_EVERY, duration, make_bar
from taichi_sph.system import processors

JobType = TypeVar("JobType")
ResultType = TypeVar("ResultType")


@dataclass(frozen=True)
class Finished(Generic[JobType, ResultType]):
    """Job that has ended."""

    job: JobType
    result: ResultType | None
    error: Exception | None
    """What it raised, or that its process was killed ATTEMPTS times."""

    def value(self) -> ResultType:
        """The result.

        Raises:
            Exception: the error, if there is one.
        """
        if self.error is not None:
            raise self.error
        return self.result  # type: ignore[return-value]


class JobProgress:
    """How many jobs are done and the time left, on stderr: a bar, or now and then a line."""

    def __init__(self, title: str, count: int, console: Console | None = None):
        """Show so many jobs."""
        self._console = console or Console(file=sys.stderr, markup=False, emoji=False)
        self._title, self._count, self._finished = title, count, 0
        self._begun = self._shown = time.perf_counter()
        self._bar: Bar | None = None
        if self._console.is_terminal:
            self._bar = make_bar(self._console, transient=True)
            self._task = self._bar.add_task(title, total=count, state="")
            self._bar.start()

    def state(self, done: float, now: float) -> str:
        """Where things stand: `done` jobs, parts of jobs too, at a time of the clock [s]."""
        text = f"{self._finished} of {self._count}"
        seconds = now - self._begun
        if 0.0 < done < self._count and seconds > 0.0:
            text += f", {duration(seconds / done * (self._count - done))} left"
        return text

    def so_far(self) -> str:
        """Where things stand, by the jobs that have ended."""
        return self.state(self._finished, time.perf_counter())

    def show(self, done: float) -> None:
        """Show that so many jobs are done, counting parts of those under way."""
        now = time.perf_counter()
        if self._bar:
            self._bar.update(self._task, completed=done, state=self.state(done, now))
        elif now - self._shown >= LINE_EVERY:
            self.say(f"{self._title}: {100 * done / self._count:.0f} %, {self.state(done, now)}")

    def finish(self) -> None:
        """Count a job that has ended."""
        self._finished += 1

    def say(self, text: str) -> None:
        """Print a line."""
        self._shown = time.perf_counter()
        self._console.print(text, soft_wrap=True, highlight=False, markup=False)

    def close(self) -> None:
        """Leave the terminal as it was."""
        if self._bar:
            self._bar.stop()


def run_jobs(
    work: Callable[[JobType], ResultType],
    jobs: Sequence[JobType],
    processes: int = 1,
    scheduler: str | None = None,
    title: str = "jobs",
    show: Callable[[JobProgress, Finished[JobType, ResultType]], None] | None = None,
) -> Generator[Finished[JobType, ResultType], None, None]:
    """Call a function for each job in a process of its own; yields them as they end.

    Args:
        work: a function of a module, which takes a job and returns what can be pickled.
        jobs: what can be pickled.  On a cluster the content of every file that a path in them, or
            a scene, names goes with them: a job may be read anywhere, but must write nothing.
        processes: how many at once; on a cluster its workers decide.
        scheduler: "dask:ADDRESS", the scheduler of a Dask cluster; this machine by default.
        title: what the progress is called.
        show: says what came of a job, through `JobProgress.say`, so that a bar stays whole.

    Raises:
        InputError: the scheduler cannot be used.
        RunError: the scheduler was lost.
    """
    if not jobs:
        return
    if scheduler is None:
        events = run_here(work, jobs, processes)
    else:
        events = run_on_cluster(work, jobs, scheduler)
    progress = JobProgress(title, len(jobs))
    try:
        with contextlib.closing(events):
            for event in events:
                if event.sentence:
                    progress.say(event.sentence)
                if event.ended is not None:
                    finished = Finished(jobs[event.ended], event.result, event.error)
                    progress.finish()
                    if show is not None:
                        show(progress, finished)
                    yield finished
                progress.show(event.done)
    finally:
        progress.close()


def run_here(
    work: Callable[[Any], Any], jobs: Sequence[Any], processes: int
) -> Generator[Event, None, None]:
    """Run jobs on this machine; yields what happens, and how far they are every POLL."""
    waiting = deque(range(len(jobs)))
    killed: Counter[int] = Counter()
    running: dict[int, Process] = {}
    at_once = min(processes, len(jobs))
    threads = max(1, len(processors()) // at_once) if at_once > 1 else None
    ended = 0
    try:
        while waiting or running:
            while waiting and len(running) < at_once:
                number = waiting.popleft()
                running[number] = Process(pickle.dumps((work, (jobs[number],))), threads)
            time.sleep(POLL)
            yield Event(ended + sum(process.done for process in running.values()))
            for number in [k for k, process in running.items() if process.has_ended]:
                process = running.pop(number)
                try:
                    result, error = process.answer()
                except ProcessError as death:
                    killed[number] += 1
                    if killed[number] < ATTEMPTS:
                        waiting.appendleft(number)
                        yield Event(ended, sentence=f"{jobs[number]}: {death}; trying again")
                        continue
                    result, error = None, ProcessError(f"{jobs[number]}: {death}, {ATTEMPTS} times")
                ended += 1
                yield Event(ended, number, result, error)
    finally:
        for process in running.values():
            process.stop()
