"""A Dask cluster on loopback: a scheduler and workers, processes that a test may kill."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from places import ROOT

PATIENCE = 60.0
"""Longest wait for a process to be there [s]: it imports Dask beside other tests."""


@dataclass
class Cluster:
    """A scheduler and its workers, one thread each; a worker that is killed stays so."""

    address: str
    """As `--scheduler` takes it."""
    scheduler: subprocess.Popen
    workers: list[subprocess.Popen]


@contextlib.contextmanager
def cluster(folder: Path, count: int = 2) -> Iterator[Cluster]:
    """Start a scheduler with so many workers, and end what is left of them."""
    here = str(ROOT / "tests" / "helpers")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(ROOT), here))}
    told = folder / "scheduler.json"

    def start(name: str, *options: str) -> subprocess.Popen:
        command = [sys.executable, "-m", f"distributed.cli.dask_{name}", "--no-dashboard",
                   "--scheduler-file", str(told), *options]  # fmt: skip
        log = (folder / f"{name}-{time.monotonic_ns()}.log").open("w")
        with log:
            return subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log)

    running = [start("scheduler", "--host", "127.0.0.1", "--port", "0")]
    try:
        wait_for(lambda: told.exists() and told.stat().st_size > 0)
        for _ in range(count):
            running.append(start("worker", "--no-nanny", "--nthreads", "1"))
        from distributed import Client

        with Client(scheduler_file=str(told), timeout=PATIENCE, set_as_default=False) as client:
            client.wait_for_workers(count, timeout=PATIENCE)
            address = client.scheduler.address
        yield Cluster(f"dask:{address}", running[0], running[1:])
    finally:
        for process in running:
            process.kill()
            process.wait()


def wait_for(condition) -> None:
    """Wait until something is so, or fail."""
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, f"not so after {PATIENCE:g} s"
        time.sleep(0.05)
