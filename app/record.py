"""Record runs of the physics for training: one process a run, one file of all runs."""

import contextlib
import hashlib
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rich.console import Console

from app.output import check_output
from app.progress import Progress, duration
from nn import dataset
from nn.dataset import Facts, Proxies, RunWriter, State, Substeps
from taichi_sph.errors import InputError, RunError
from taichi_sph.scene import Scene, read_scene

Show = Callable[[int, int, int], None]
"""Told a run's number, its states so far and its sub-steps so far."""


@dataclass(frozen=True)
class Task:
    """All that a process needs to record a run."""

    number: int
    scene: Scene
    """With the run's own column."""
    facts: Facts
    part: Path
    """The run's file while it is under way."""
    threads: int | None


@dataclass(frozen=True)
class Recording:
    """What was recorded."""

    out: Path
    facts: tuple[Facts, ...]
    resumed: int
    """States that were there already."""
    size: int
    """Of the file [bytes]."""
    wall_time: float
    """[s]"""

    def __str__(self) -> str:
        first = self.facts[0]
        particles = ", ".join(str(f.particles) for f in self.facts)
        there = f", {self.resumed} states were there already" if self.resumed else ""
        return (
            f"{self.out}: {len(self.facts)} runs of {first.frames} frames, {self.size / 1e6:.1f} "
            f"MB, {duration(self.wall_time)}{there}\n"
            f"  blood particles {particles}; frame interval {1e3 * first.frame_interval:.4g} ms = "
            f"{first.substeps} x {1e3 * first.substep:.4g} ms"
        )


def record(
    scene_path: Path,
    heights: Sequence[float],
    frames: int,
    out: Path,
    substeps: int = 4,
    features: bool = False,
    processes: int = 1,
    arch: str = "cpu",
    threads: int | None = None,
    seed: int = 0,
    scheduler: str | None = None,
) -> Recording:
    """Record one run of a scene for each column height into a dataset.

    A recording that was cut short goes on where it was: every run has a file of its own beside
    `out` until all are done.

    Args:
        scene_path: the scene's file.
        heights: of the blood column [m], one a run.
        frames: frames with a target, a run.
        out: the dataset.
        substeps: sub-steps M in a frame interval.
        features: store features and targets too.
        processes: how many runs at once; the result is the same.
        arch: cpu or gpu.
        threads: CPU threads of each process; all of them shared out by default.
        seed: of the proxies' places.
        scheduler: "dask:ADDRESS" records on a cluster that sees the same folders.

    Raises:
        InputError: something given is of no use; found before anything is simulated.
        RunError: a run diverged, or its process was killed.
        OSError: the disk is full.
    """
    began = time.perf_counter()
    check_output(out, "--out", dataset.SIGNATURE)
    tasks = plan(scene_path, heights, frames, out, substeps, features, arch, threads, seed)
    everything = tuple(task.facts for task in tasks)
    states = len(tasks) * (frames + 1)
    if out.exists() and out.stat().st_size > 0:
        _require_recorded(out, everything)
        return Recording(out, everything, states, out.stat().st_size, 0.0)
    if threads is None:
        shared = max(1, (os.cpu_count() or 1) // min(processes, len(tasks)))
        tasks = [msgspec_replace(task, shared) for task in tasks]
    resumed = {}
    interval = everything[0].frame_interval
    progress = Progress(len(tasks) * frames * interval, tasks[0].scene.name)
    seen: dict[int, tuple[int, int]] = {}

    def show(number: int, done: int, steps: int) -> None:
        resumed.setdefault(number, done)
        seen[number] = (done, steps)
        simulated = sum(max(0, d - 1) for d, _ in seen.values()) * interval
        progress.show(simulated, sum(s for _, s in seen.values()), 0)

    try:
        if scheduler is None:
            run_locally(tasks, processes, show)
        else:
            run_on_cluster(tasks, scheduler, show)
    finally:
        progress.close()
    console = Console(file=sys.stderr)
    with console.status(f"writing {out}"):
        dataset.merge([task.part for task in tasks], out)
    wall_time = time.perf_counter() - began
    return Recording(out, everything, sum(resumed.values()), out.stat().st_size, wall_time)
