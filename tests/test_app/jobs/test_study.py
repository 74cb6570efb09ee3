"""Studies go on where they were, keep each row as it comes, and bear jobs that fail."""

from dataclasses import dataclass

import pytest

from app.jobs import study
from app.jobs.runner import Finished, JobProgress
from app.jobs.study import run_study
from taichi_sph.errors import InputError, RunError


@dataclass(frozen=True)
class Row:
    key: str
    value: int


@dataclass(frozen=True)
class Job:
    key: str
    error: Exception | None = None


def measure(job: Job) -> list[Row]:
    if job.error is not None:
        raise job.error
    return [Row(job.key, len(job.key))]


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Keys of the jobs that are run: here and now, in this process."""
    keys: list[str] = []

    def run_jobs(work, jobs, processes, scheduler, title, show):
        progress = JobProgress(title, len(jobs))
        for job in jobs:
            keys.append(job.key)
            try:
                ended = Finished(job, work(job), None)
            except (InputError, RunError) as error:
                ended = Finished(job, None, error)
            show(progress, ended)
            yield ended

    monkeypatch.setattr(study, "run_jobs", run_jobs)
    return keys


def run(jobs: list[Job], rows: list[Row] | None = None) -> tuple[list[Row], list[list[Row]]]:
    """All rows at the end, and what was saved after each job."""
    saved: list[list[Row]] = []
    tell = lambda found: f"{found[0].key} is measured"  # noqa: E731
    found = run_study(rows or [], jobs, measure, lambda r: saved.append(list(r)), tell, "study")
    return found, saved


def test_only_what_is_missing_is_measured_and_saved_as_it_comes(
    asked: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    found, saved = run([Job("a"), Job("bb"), Job("ccc")], [Row("bb", 2)])
    assert asked == ["a", "ccc"]
    assert [row.key for row in found] == ["bb", "a", "ccc"]
    assert [len(rows) for rows in saved] == [2, 3]
    assert "ccc is measured" in capsys.readouterr().err
    asked.clear()
    again, saved = run([Job("a"), Job("bb"), Job("ccc")], found)
    assert (again, asked, saved) == (found, [], [])


def test_what_cannot_be_done_is_left_out_and_said(
    asked: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    found, _ = run([Job("a", InputError("too coarse")), Job("bb")])
    assert [row.key for row in found] == ["bb"]
    assert "left out: too coarse" in capsys.readouterr().err
    with pytest.raises(InputError, match="too coarse"):
        run([Job("a", InputError("too coarse"))])


def test_what_was_killed_is_missing_and_the_others_are_saved(asked: list[str]) -> None:
    saved: list[Row] = []
    jobs = [Job("a", RunError("its process was ended by SIGKILL, 3 times")), Job("bb")]
    with pytest.raises(RunError, match=r"study: 1 of 2 are missing, the first: its process was"):
        run_study([], jobs, measure, saved.extend, lambda rows: rows[0].key, "study")
    assert [row.key for row in saved] == ["bb"]
