"""`vesselflow bench`: what a step costs, beside a peer in the same run, over size, and at start.

Every row is measured in a process of its own, since Taichi frees no field.  Times are medians over
frames or blocks of steps, neighbour search included; nothing is logged or drawn meanwhile.
"""

import math
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from app.files import check_plots, console, table, write_json
from app.jobs.process import in_own_process
from app.scenes.library import weights_for, with_column
from app.studies.splishsplash import begin, require_peer, rigid_wall
from taichi_sph.errors import InputError
from taichi_sph.scene import Scene, parse_scene, read_scene
from taichi_sph.system import largest_memory

if TYPE_CHECKING:
    from rich.table import Table

FRAMES_A_BLOCK = 10
"""Steps of PcNet between two changes of side."""

BLOCK = 20
"""Steps between two changes of side when two programs are timed in turn."""

SPEED_OF_PEER_COLUMN = 10.0
"""Sound speed of the column that both programs hold [m/s]."""


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


def _row(case: str, blood: int, proxies: int, steps: list[float], dt: float) -> Row:
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


PAPER = {
    ("A", 16000): (26.0, 5.1),
    ("A", 32000): (33.0, 6.3),
    ("B", 16000): (30.0, 6.4),
    ("B", 32000): (35.0, 7.4),
}
"""Table 1 of the paper: physics and PcNet [ms]."""


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
        _row(f"{scene.name}, {side.model.name}", d.blood_particles, d.proxy_particles, cost, step)
        for side, cost, step in zip(sides, costs, (sides[0].last_step, frame), strict=True)
    )
    frames = [float(np.median(wall)) for wall in walls]
    paper = PAPER.get((scene.name, d.blood_particles), (math.nan, math.nan))
    return Pair(
        scene.name, d.blood_particles, d.proxy_particles, d.blood_particles + d.proxy_particles,
        sides[0].steps / sides[1].steps, physics, pcnet, 1e3 * frames[0], 1e3 * frames[1],
        frames[0] / frames[1], *paper,
    )  # fmt: skip


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
    return _row(
        simulation.scene.name, d.blood_particles, d.proxy_particles, costs, simulation.last_step
    )


def _step_costs(
    weights: Path, arch: str, threads: int | None, until: float, scene: Scene
) -> tuple[float, float]:
    """What a step costs the physics and PcNet [ms]."""
    pair = in_own_process(measure_scene, scene, weights, arch, threads, until)
    return pair.physics.step_ms, pair.pcnet.step_ms


def _blocks(step: Callable[[], Any], count: int) -> float:
    """Mean seconds of a step over `count` blocks."""
    before = time.perf_counter()
    for _ in range(count * BLOCK):
        step()
    return (time.perf_counter() - before) / (count * BLOCK)


def _start_peer(folder: Path, across: int, height: int, fill: int, dt: float, sound: float) -> Any:
    """SPlisHSPlasH's WCSPH with a like column in a like tank; returns (step, blood, proxies)."""
    import trimesh

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
            "WCSPH": {"stiffness": 1060.0 * sound**2 / 7.0, "exponent": 7},
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
        rows.append(_row("column, vesselflow", d.blood_particles, d.proxy_particles, ours[2:], dt))
        rows.append(_row("column, SPlisHSPlasH WCSPH", blood, proxies, theirs[2:], dt))
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


def _machine(arch: str, threads: int | None) -> dict[str, Any]:
    """What the figures were measured on."""
    model = platform.processor()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [s for s in cpuinfo.read_text().splitlines() if s.startswith("model name")]
        model = names[0].partition(":")[2].strip() if names else model
    import taichi

    return {
        "processor": model,
        "cores": os.cpu_count(),
        "threads": threads or os.cpu_count(),
        "arch": arch,
        "precision": "f32",
        "python": platform.python_version(),
        "taichi": ".".join(map(str, taichi.__version__)),
        "commit": _commit(),
    }


def _commit() -> str:
    """Commit of the source tree; empty of an installed package."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    try:
        return subprocess.run(command, capture_output=True, text=True).stdout.strip()
    except OSError:
        return ""


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


def main(
    scenes: Sequence[tuple[Path, int | None]],
    until: float = 0.1,
    arch: str = "cpu",
    threads: int | None = None,
    peer: bool = False,
    scale: bool = False,
    start_up: bool = False,
    split: bool = False,
    real_time: bool = False,
    control: bool = False,
    plot: Path | None = None,
    json_file: Path | None = None,
) -> int:
    """Measure and print; returns the exit code.

    Raises:
        InputError: the peer is asked for and not installed, or the time is too short.
    """
    if peer:
        require_peer()
    if plot is not None:
        check_plots(plot)
    terminal = console()
    machine = _machine(arch, threads)
    terminal.print(", ".join(f"{key} {value}" for key, value in machine.items()))
    pairs: list[Pair] = []
    for path, particles in scenes:
        scene = with_column(read_scene(path), particles, None)
        weights = weights_for(scene)
        pairs.append(in_own_process(measure_scene, scene, weights, arch, threads, until))
    rows: list[Row] = [row for pair in pairs for row in (pair.physics, pair.pcnet)]
    if pairs:
        terminal.print(table_1(pairs))
    notes = []
    if peer:
        ours, theirs = in_own_process(measure_peer, threads)
        rows += [ours, theirs]
        ratio = ours.microseconds_per_particle_step / theirs.microseconds_per_particle_step
        notes.append(f"a particle-step of the column costs {ratio:.2f} of the peer's")
        notes += [
            f"a particle-step of {row.case} costs "
            f"{row.microseconds_per_particle_step / theirs.microseconds_per_particle_step:.2f} "
            "of the peer's"
            for row in rows[: 2 * len(pairs)]
        ]
    if scale:
        sizes = [in_own_process(measure_column, *s, arch, threads) for s in COLUMNS]
        rows += sizes
        costs = [row.microseconds_per_particle_step for row in sizes]
        notes.append(
            f"cost a particle-step from {sizes[0].blood_particles} to {sizes[-1].blood_particles} "
            f"blood particles: {min(costs):.3f} to {max(costs):.3f} us, "
            f"{max(costs) / min(costs) - 1:.0%} apart"
        )
    costs_table = table(
        "cost of a step, neighbour search included",
        "case", "blood", "proxies", "step ms", "quartiles", "us/particle", "real time", "MiB",
    )  # fmt: skip
    for row in rows:
        costs_table.add_row(
            row.case,
            str(row.blood_particles),
            str(row.proxy_particles),
            f"{row.step_ms:.2f}",
            f"{row.step_ms_low:.2f}-{row.step_ms_high:.2f}",
            f"{row.microseconds_per_particle_step:.3f}",
            f"{row.real_time_factor:.5f}",
            f"{row.memory_mib:.0f}",
        )
    terminal.print(costs_table)
    for note in notes:
        terminal.print(note)
    paths = list(dict.fromkeys(path for path, _ in scenes))
    starts = {}
    if start_up:
        for path in paths:
            starts[str(path)] = measure_start(str(path), arch)
            cold, warm = starts[str(path)]
            name = read_scene(path).name
            terminal.print(f"{name} to the first step: {cold:.1f} s cold, {warm:.1f} s warm")
    passes: list[Any] = []
    limits: Any = None
    if split:
        from app.bench import profile

        for path in paths:
            scene = read_scene(path)
            weights = weights_for(scene)
            some, reached = in_own_process(profile.measure_passes, scene, weights, arch, threads)
            passes += some
            limits = reached if limits is None else limits.best(reached)
        terminal.print(profile.passes_table(passes, limits))
        if plot is not None:
            profile.draw(passes, limits, plot / "passes.png")
    curves: list[Any] = []
    if real_time:
        from app.bench import realtime

        for path in paths:
            scene = read_scene(path)
            weights = weights_for(scene)
            cost = partial(_step_costs, weights, arch, threads, until)
            curves += realtime.curves(scene, weights, cost)
        terminal.print(realtime.curves_table(curves))
        if plot is not None:
            realtime.draw(curves, plot / "real_time.png")
    overheads: list[Any] = []
    if control:
        from app.bench.control_cost import measure_overhead, overhead_table

        for path in paths:
            scene = read_scene(path)
            with tempfile.TemporaryDirectory() as folder:
                overheads.append(
                    in_own_process(
                        measure_overhead, scene, weights_for(scene), arch, threads, Path(folder)
                    )
                )
        terminal.print(overhead_table(overheads))
    if json_file:
        result = {"machine": machine, "table": [asdict(p) for p in pairs]}
        result |= {"rows": [asdict(r) for r in rows], "starts": starts}
        result |= {"passes": [asdict(p) for p in passes]}
        result |= {"limits": asdict(limits) if split else {}}
        result |= {"real_time": [asdict(curve) for curve in curves]}
        result |= {"control": [asdict(row) for row in overheads]}
        write_json(json_file, result)
    return 0


COLUMNS = ((20, 40), (32, 61), (50, 100), (80, 157))
"""Columns of --scale: particles across and high; 16 000, 62 464, 250 000 and 1 004 800."""
