"""Columns of blood in square tanks: a step's cost over size and beside a peer; a run's start."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from app.studies.splishsplash import begin, rigid_wall
from taichi_sph.scene import Scene, parse_scene
from taichi_sph.system import largest_memory

BLOCK = 20
"""Steps between two changes of side when two programs are timed in turn."""

COLUMNS = ((20, 40), (32, 61), (50, 100), (80, 157))
"""Columns of --scale: particles across and high; 16 000, 62 464, 250 000 and 1 004 800."""


@dataclass(frozen=True)
class Row:
    """One measured case."""

    case: str
    blood_particles: int
    proxy_particles: int
    step_ms: float
    """Median cost of a step [ms]."""
    step_ms_low: float
    """First quartile."""
    step_ms_high: float
    """Third quartile."""
    microseconds_per_particle_step: float
    real_time_factor: float
    """Simulated seconds per wall second."""
    memory_mib: float
    """Largest resident memory of the process [MiB]."""


def row_of(case: str, blood: int, proxies: int, steps: list[float], dt: float) -> Row:
    """A row from the costs of some steps [s] that each simulate `dt` [s]."""
    low, middle, high = np.percentile(steps, [25, 50, 75])
    return Row(
        case=case,
        blood_particles=blood,
        proxy_particles=proxies,
        step_ms=1e3 * middle,
        step_ms_low=1e3 * low,
        step_ms_high=1e3 * high,
        microseconds_per_particle_step=1e6 * middle / blood,
        real_time_factor=dt / middle,
        memory_mib=largest_memory() / 2**20,
    )


def _box_scene(across: int, height: int, fill: int, wall_ratio: float, folder: Path) -> Scene:
    """A column of `across` x `across` x `fill` particles in a square tank, spacing 1 mm."""
    import trimesh

    d = 1e-3
    size = np.array([across, across, height]) * d
    trimesh.creation.box(extents=size).export(folder / "box.stl")
    text = f"""
title = "square tank"
duration = 1.0
frame_interval = 0.005
gravity = [0.0, 0.0, -9.81]
[vessel]
surface = "box.stl"
[openings.top]
centre = [0.0, 0.0, {size[2] / 2}]
state = "open"
[column]
opening = "top"
offset = {(height - fill) * d}
particles = {across * across * fill}
[blood]
rheology = {{ model = "newtonian" }}
[discretization]
spacing = {d}
wall_spacing_ratio = {wall_ratio}
"""
    return parse_scene(text, "bench", folder, f"box {across}x{across}x{fill}")


def measure_column(across: int, fill: int, arch: str, threads: int | None) -> Row:
    """Cost of a step of a settling column in a tank just larger than it."""
    from taichi_sph import Simulation, start

    start(arch, threads=threads)
    with tempfile.TemporaryDirectory() as folder:
        simulation = Simulation.from_scene(_box_scene(across, fill + 10, fill, 1.0, Path(folder)))
    _blocks(lambda: simulation.step(1.0), 1)
    costs = [_blocks(lambda: simulation.step(1.0), 1) for _ in range(8)]
    d = simulation.derived
    return row_of(
        simulation.scene.name, d.blood_particles, d.proxy_particles, costs, simulation.last_step
    )


def _blocks(step: Callable[[], Any], count: int) -> float:
    """Mean seconds of a step over `count` blocks."""
    before = time.perf_counter()
    for _ in range(count * BLOCK):
        step()
    return (time.perf_counter() - before) / (count * BLOCK)


def _start_peer(folder: Path, across: int, height: int, fill: int, dt: float, sound: float) -> Any:
    """SPlisHSPlasH's WCSPH with a like column in a like tank; returns (step, blood, proxies)."""
    import trimesh

    from taichi_sph.fluid.equation_of_state import Tait

    d = 1e-3
    # Its first layer stands one spacing off the wall, ours half of one.
    size = np.array([across + 1, across + 1, height]) * d
    mesh = trimesh.creation.box(extents=size)
    mesh.apply_translation([0.0, 0.0, size[2] / 2])
    mesh.export(folder / "tank.obj")
    half = 0.5 * (across + 1) * d
    scene = {
        "Configuration": {
            "particleRadius": d / 2,
            "numberOfStepsPerRenderUpdate": 1,
            "simulationMethod": 0,
            "gravitation": [0, 0, -9.81],
            "cflMethod": 0,
            "timeStepSize": dt,
            "WCSPH": {
                "stiffness": Tait(1060.0, sound).stiffness,
                "exponent": Tait.exponent,
            },
            "boundaryHandlingMethod": 0,
            "enableZSort": True,
        },
        "Materials": [{"id": "Fluid", "density0": 1060.0, "viscosityMethod": 1}],
        "FluidBlocks": [
            {
                "id": "Fluid",
                "denseMode": 0,
                "start": [-half, -half, 0.0],
                "end": [half, half, (fill + 1) * d],
                "translation": [0, 0, 0],
                "scale": [1, 1, 1],
            }
        ],
        "RigidBodies": [rigid_wall(folder / "tank.obj") | {"id": 1, "mapInvert": True}],
    }
    base = begin(scene, folder)
    import pysplishsplash as sph

    simulation = sph.Simulation.getCurrent()
    fluid = simulation.getFluidModel(0)
    viscosity = fluid.getViscosityBase()
    for key in (viscosity.VISCOSITY_COEFFICIENT, viscosity.VISCOSITY_COEFFICIENT_BOUNDARY):
        viscosity.setValueFloat(key, 3.5e-3 / 1060.0)
    keep = (base, simulation)  # alive as long as the step is
    return (
        lambda: keep[1].getTimeStep().step(),
        fluid.numActiveParticles(),
        simulation.getBoundaryModel(0).numberOfParticles(),
    )


def measure_peer(threads: int | None) -> list[Row]:
    """A column of 16 000 in a tank of some 58 000 proxies: ours and the peer's, in turn."""
    from taichi_sph import Simulation, start

    start("cpu", threads=threads)
    if threads:
        os.environ["OMP_NUM_THREADS"] = str(threads)
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # 0.64 gives the peer's own density of wall particles.
        simulation = Simulation.from_scene(_box_scene(20, 270, 40, 0.64, folder))
        simulation.step(1.0)
        sound = simulation.derived.sound_speed
        peer, blood, proxies = _start_peer(folder, 20, 270, 40, simulation.last_step, sound)
        ours: list[float] = []
        theirs: list[float] = []
        for _ in range(2 + 12):
            ours.append(_blocks(lambda: simulation.step(1.0), 1))
            theirs.append(_blocks(peer, 1))
        d = simulation.derived
        dt = simulation.last_step
        rows.append(
            row_of("column, vesselflow", d.blood_particles, d.proxy_particles, ours[2:], dt)
        )
        rows.append(row_of("column, SPlisHSPlasH WCSPH", blood, proxies, theirs[2:], dt))
    return rows


def measure_start(scene: str, arch: str) -> tuple[float, float]:
    """Wall seconds of a run to its first step, without and with what a first run has cached."""
    with tempfile.TemporaryDirectory() as cache:
        environment = dict(os.environ, TI_OFFLINE_CACHE_FILE_PATH=cache, XDG_CACHE_HOME=cache)
        times = []
        for _ in range(2):
            before = time.perf_counter()
            subprocess.run(
                [sys.executable, "-m", "app", "run", scene, "--until", "1e-6", "--arch", arch],
                check=True,
                env=environment,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            times.append(time.perf_counter() - before)
    return times[0], times[1]
