"""Studies: jobs whose rows are kept in a file as they come, and which go on where they were."""

import contextlib
from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import Protocol, TypeVar

from app.jobs.runner import Finished, JobProgress, run_jobs
from taichi_sph.errors import InputError, RunError


class Keyed(Protocol):
    """What has a key: rows and jobs of one key belong together."""

    @property
    def key(self) -> Hashable:
        """What it is of."""


RowType = TypeVar("RowType", bound=Keyed)
JobType = TypeVar("JobType", bound=Keyed)


def run_study(
    rows: Iterable[RowType],
    jobs: Sequence[JobType],
    measure: Callable[[JobType], list[RowType]],
    save: Callable[[list[RowType]], None],
    tell: Callable[[list[RowType]], str],
    title: str,
    processes: int = 1,
    scheduler: str | None = None,
) -> list[RowType]:
    """Measure what is missing, each job in a process of its own; all rows that there then are.

    A job that cannot be done is said and left out, and so is one whose process was killed again and
    again; the others go on.

    Args:
        rows: what was measured before.
        jobs: all that is wanted; one whose key a row has is not done again.
        measure: the rows of a job, at least one; called in another process.
        save: keeps all rows, after each job.
        tell: what to say of a job's rows.
        title: what the progress is called.
        processes: how many jobs at once.
        scheduler: see `run_jobs`.

    Raises:
        InputError: the scheduler cannot be used, or nothing of it all can be done.
        RunError: some jobs failed, whose rows are missing; the others are saved.
    """
    found = list(rows)
    there = {row.key for row in found}
    missing = [job for job in jobs if job.key not in there]

    def show(progress: JobProgress, ended: Finished[JobType, list[RowType]]) -> None:
        if ended.error is None:
            text = tell(ended.value())
        else:
            text = f"{ended.job}: left out: {ended.error}"
        progress.say(f"{text} ({progress.so_far()})")

    refused: list[Exception] = []
    failed: list[Exception] = []
    running = run_jobs(measure, missing, processes, scheduler, title, show)
    with contextlib.closing(running):
        for ended in running:
            if isinstance(ended.error, InputError):
                refused.append(ended.error)
            elif isinstance(ended.error, RunError):
                failed.append(ended.error)
            else:
                found += ended.value()
                save(found)
    if failed:
        raise RunError(
            f"{title}: {len(failed)} of {len(missing)} are missing, the first: {failed[0]}; the "
            "same command tries them again"
        )
    if refused and not found:
        raise refused[0]
    return found
