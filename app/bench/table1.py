"""The paper's Table 1: physics and PcNet on one scene, poured in turn, block by block."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from app.bench.columns import Row, row_of
from app.files import table
from app.jobs.process import in_own_process
from taichi_sph.errors import InputError
from taichi_sph.scene import Scene

if TYPE_CHECKING:
    from rich.table import Table

FRAMES_A_BLOCK = 10
"""Steps of PcNet between two changes of side."""

PAPER = {
    ("A", 16000): (26.0, 5.1),
    ("A", 32000): (33.0, 6.3),
    ("B", 16000): (30.0, 6.4),
    ("B", 32000): (35.0, 7.4),
}
"""Table 1 of the paper: physics and PcNet [ms]."""


@dataclass(frozen=True)
class Pair:
    """A line of the paper's Table 1: physics and PcNet on one scene, poured in turn."""

    scene: str
    blood_particles: int
    proxy_particles: int
    particles: int
    """Both."""
    substeps: float
    """Steps of the physics in one of PcNet."""
    physics: Row
    pcnet: Row
    physics_frame_ms: float
    """What the physics needs for the time of a PcNet step [ms]."""
    pcnet_frame_ms: float
    speed_up: float
    paper_physics_ms: float
    """The paper's figures for the same sizes on a GTX 650 Ti [ms]; NaN of another scene."""
    paper_pcnet_ms: float


def measure_scene(
    scene: Scene, weights: Path, arch: str, threads: int | None, duration: float
) -> Pair:
    """Cost of a step over the first `duration` [s] of a scene: medians over blocks."""
    from nn.pcnet import load_pcnet
    from taichi_sph import Simulation, start
    from taichi_sph.geometry.vessel import read_vessel

    start(arch, threads=threads)
    vessel = read_vessel(scene)
    network = load_pcnet(weights, scene)
    sides = [
        Simulation.from_scene(scene, vessel=vessel),
        Simulation.from_scene(scene, network, vessel=vessel),
    ]
    frame = sides[1].model.stable_step(0.0, 0.0)
    block = FRAMES_A_BLOCK * frame
    if round(duration / block) < 2:
        raise InputError(
            f"--until {duration:g}: the first {FRAMES_A_BLOCK} steps of PcNet compile and are not "
            f"timed; give at least {2.0 * block:.2g} s for {scene.name}"
        )
    costs: list[list[float]] = [[], []]
    walls: list[list[float]] = [[], []]
    for k in range(1, round(duration / block) + 1):
        for side, cost, wall in zip(sides, costs, walls, strict=True):
            steps, before = side.steps, time.perf_counter()
            side.advance_to(k * block)
            taken = time.perf_counter() - before
            if k > 1:  # the first compiles
                cost.append(taken / max(1, side.steps - steps))
                wall.append(taken / FRAMES_A_BLOCK)
        if not all(side.particles.count[None] for side in sides):
            break
    d = sides[0].derived
    physics, pcnet = (
        row_of(f"{scene.name}, {side.model.name}", d.blood_particles, d.proxy_particles, cost, step)
        for side, cost, step in zip(sides, costs, (sides[0].last_step, frame), strict=True)
    )
    frames = [float(np.median(wall)) for wall in walls]
    paper = PAPER.get((scene.name, d.blood_particles), (math.nan, math.nan))
    return Pair(
        scene.name, d.blood_particles, d.proxy_particles, d.blood_particles + d.proxy_particles,
        sides[0].steps / sides[1].steps, physics, pcnet, 1e3 * frames[0], 1e3 * frames[1],
        frames[0] / frames[1], *paper,
    )  # fmt: skip


def step_costs(
    weights: Path, arch: str, threads: int | None, until: float, scene: Scene
) -> tuple[float, float]:
    """What a step costs the physics and PcNet [ms]."""
    pair = in_own_process(measure_scene, scene, weights, arch, threads, until)
    return pair.physics.step_ms, pair.pcnet.step_ms


def table_1(pairs: Sequence[Pair]) -> "Table":
    """The paper's Table 1 with ours beside it; a frame is the time of a PcNet step."""
    found = table(
        "a frame (one step of PcNet), neighbour search included; in brackets the paper's",
        "scene", "blood", "proxies", "all", "physics ms", "PcNet ms", "speed-up", "sub-steps",
        "real time, physics", "PcNet",
    )  # fmt: skip
    for p in pairs:
        paper = (f" ({p.paper_physics_ms:.0f})", f" ({p.paper_pcnet_ms:.1f})")
        ratio = f" ({p.paper_physics_ms / p.paper_pcnet_ms:.1f})"
        if math.isnan(p.paper_pcnet_ms):
            paper, ratio = ("", ""), ""
        found.add_row(
            p.scene,
            str(p.blood_particles),
            str(p.proxy_particles),
            str(p.particles),
            f"{p.physics_frame_ms:.1f}{paper[0]}",
            f"{p.pcnet_frame_ms:.1f}{paper[1]}",
            f"{p.speed_up:.2f}{ratio}",
            f"{p.substeps:.1f}",
            f"{p.physics.real_time_factor:.5f}",
            f"{p.pcnet.real_time_factor:.5f}",
        )
    return found
