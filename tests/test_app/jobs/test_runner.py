"""Jobs on this machine: results, errors, killed processes, an end in mid-run."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from app.jobs.process import ATTEMPTS, in_own_process
from app.jobs.runner import JobProgress, run_jobs
from cluster import wait_for
from places import ROOT
from taichi_sph.errors import InputError, RunError
from work import Errand, run_errand


def test_jobs_run_at_once_and_come_as_they_end() -> None:
    jobs = [Errand(0, "slow"), *(Errand(k) for k in range(1, 4))]
    found = {done.job.number: done.value() for done in run_jobs(run_errand, jobs, processes=2)}
    assert found == {0: 0, 1: 1, 2: 4, 3: 9}
    assert list(found)[-1] != 1, "the first waits for no one"


def test_what_a_job_raises_is_its_own_and_the_others_go_on() -> None:
    jobs = [Errand(1, "refuse"), Errand(2)]
    refused, squared = sorted(run_jobs(run_errand, jobs), key=lambda done: done.job.number)
    with pytest.raises(InputError, match="errand 1: refused"):
        refused.value()
    assert squared.value() == 4


def test_a_killed_process_is_tried_again_and_then_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    notes = tmp_path / "notes"
    jobs = [Errand(1, "die once", notes), Errand(2, "die", notes), Errand(3)]
    found = {done.job.number: done for done in run_jobs(run_errand, jobs, processes=3)}
    assert found[1].value() == 1
    assert found[3].value() == 9
    with pytest.raises(RunError, match=f"errand 2: its process was ended by SIGKILL, {ATTEMPTS}"):
        found[2].value()
    tries = [line.split()[0] for line in notes.read_text().splitlines()]
    assert (tries.count("1"), tries.count("2")) == (2, ATTEMPTS)
    assert "errand 1: its process was ended by SIGKILL; trying again" in capsys.readouterr().err


def test_a_process_that_leaves_no_result_is_a_sentence() -> None:
    with pytest.raises(RunError, match="run_errand: its process ended with exit code 3"):
        in_own_process(run_errand, Errand(1, "exit"))
    assert in_own_process(run_errand, Errand(5)) == 25


def alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    # A process that nobody has asked for stays in the table.
    return " Z " not in Path(f"/proc/{process}/stat").read_text()


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_nothing_runs_on_when_who_waits_is_gone(number: int, tmp_path: Path) -> None:
    notes = tmp_path / "notes"
    code = (
        "from pathlib import Path; from app.jobs.runner import run_jobs; from work import *\n"
        f"jobs = [Errand(k, 'wait', Path({str(notes)!r})) for k in range(2)]\n"
        "list(run_jobs(run_errand, jobs, processes=2))"
    )
    paths = os.pathsep.join((str(ROOT), str(ROOT / "tests" / "helpers")))
    waiting = subprocess.Popen(
        [sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": paths},
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    wait_for(lambda: notes.exists() and len(notes.read_text().splitlines()) == 2)
    waiting.send_signal(number)
    waiting.wait(30.0)
    workers = [int(line.split()[1]) for line in notes.read_text().splitlines()]
    wait_for(lambda: not any(alive(worker) for worker in workers))


def test_progress_says_how_many_and_how_long() -> None:
    with open(os.devnull, "w") as nowhere:
        progress = JobProgress("stability", 8, Console(file=nowhere))
        now = time.perf_counter()
        progress._begun = now - 30.0
        progress.finish()
        # Three quarters of the work are left after 30 s for the first quarter.
        assert progress.state(2.0, now) == "1 of 8, 1 min 30 s left"
        assert progress.state(0.0, now) == "1 of 8"
