"""`vesselflow stability`: which methods live where methods fail.

A case is a start, a scene and a time; CASES has them all.  Every method of METHODS meets every case
from several starts, and app.metrics says when it is dead.  Physics and networks are judged alike.
"""

import math
import multiprocessing
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from app.files import console, read_rows, table, write_rows
from app.models import MODELS
from app.scenes.library import find_scene
from app.studies.methods import SOFT, Method, of_weights
from app.studies.timed_run import RULES, TimedRun, Trace
from taichi_sph.errors import InputError
from taichi_sph.scene import Scene
from taichi_sph.simulation import Simulation

Start = tuple[np.ndarray, np.ndarray]
"""Positions [m] and velocities [m/s] of the blood, (n, 3) each."""
Begin = Callable[[Simulation, np.random.Generator], Start]
Check = Callable[["Trial"], str]

FRAMES = 40
"""Looks at the state in a case."""
JITTER = 0.02
"""Every start but the first has its particles moved by as much of a spacing."""


@dataclass
class Trial:
    """One method from one start of a case."""

    pour: TimedRun
    start: Start
    case: "Case"


@dataclass(frozen=True)
class Case:
    """Where methods fail."""

    name: str
    scene: Callable[[Path], Scene]
    """Makes the scene; files it needs go into the folder given."""
    until: float
    """Simulated time [s]."""
    begin: Begin | None = None
    """Makes the start; the scene's column at rest by default."""
    check: Check | None = None
    """Says what is wrong at the end, if anything; beside the rules."""
    spacing: float = 1.0
    """Times the scene's."""
    step: float = 1.0
    """Times the method's own."""
    dies_well: str = ""
    """The case cannot be lived through: a method passes by stopping with this in its sentence."""


def shipped(
    name: str,
    spacing: float,
    height: float | None = None,
    offset: float | None = None,
    **changes: Any,
) -> Callable[[Path], Scene]:
    """A shipped scene at a spacing [m], with another column [m] or gravity."""

    def make(_: Path) -> Scene:
        scene = find_scene(name)
        grid = msgspec.structs.replace(scene.discretization, spacing=spacing)
        column = scene.column
        if height is not None:
            column = msgspec.structs.replace(column, height=height, particles=None)
        if offset is not None:
            column = msgspec.structs.replace(column, offset=offset)
        return msgspec.structs.replace(scene, discretization=grid, column=column, **changes)

    return make


def narrowed(percent: float, spacing: float, height: float) -> Callable[[Path], Scene]:
    """The stenosis with another narrowing of its radius, spacing [m] and column [m]."""

    def make(folder: Path) -> Scene:
        from app.scenes.centreline import remake
        from taichi_sph.scene import read_scene

        source = Path(find_scene("stenosis").folder)
        table = msgspec.json.decode((source / "centreline.json").read_bytes())
        table["narrowing"] = percent
        (folder / "centreline.json").write_bytes(msgspec.json.encode(table))
        (folder / "scene.toml").write_text((source / "scene.toml").read_text())
        remake(folder)
        scene = read_scene(folder / "scene.toml")
        grid = msgspec.structs.replace(scene.discretization, spacing=spacing)
        column = msgspec.structs.replace(scene.column, height=height)
        return msgspec.structs.replace(scene, discretization=grid, column=column)

    return make


def turned(name: str, spacing: float, height: float) -> Callable[[Path], Scene]:
    """A shipped scene turned about an axis that is nobody's, gravity with it."""

    def make(folder: Path) -> Scene:
        import trimesh

        scene = shipped(name, spacing, height)(folder)
        turn = trimesh.transformations.rotation_matrix(1.0, (1.0, 2.0, -1.5))
        mesh = trimesh.load_mesh(Path(scene.folder) / scene.vessel.surface)
        mesh.apply_transform(turn)
        mesh.export(folder / "lumen.ply")
        openings = {
            key: msgspec.structs.replace(o, centre=tuple(turn[:3, :3] @ np.array(o.centre)))
            for key, o in scene.openings.items()
        }
        gravity = turn[:3, :3] @ np.array(scene.gravity)
        vessel = msgspec.structs.replace(scene.vessel, surface="lumen.ply")
        return msgspec.structs.replace(
            scene,
            folder=str(folder),
            vessel=vessel,
            openings=openings,
            gravity=tuple(map(float, gravity)),
        )

    return make


# Starts


def column(simulation: Simulation, _: np.random.Generator) -> Start:
    """The scene's column at rest."""
    x = simulation.positions().astype(float)
    return x, np.zeros_like(x)


def sinking(simulation: Simulation, generator: np.random.Generator) -> Start:
    """The scene's column, already moving along gravity at 0.3 m/s."""
    x, v = column(simulation, generator)
    g = np.asarray(simulation.scene.gravity)
    return x, v + 0.3 * g / np.linalg.norm(g)


def ball(speed: float, radius: float = 3.2) -> Begin:
    """A ball of blood, so many spacings in radius, in the middle of it all; moves at a speed."""

    def make(simulation: Simulation, generator: np.random.Generator) -> Start:
        x, _ = column(simulation, generator)
        low, high = x.min(axis=0), x.max(axis=0)
        d = simulation.scene.discretization.spacing
        apart = np.linalg.norm(x - 0.5 * (low + high), axis=1)
        x = x[apart < radius * d]
        return x, np.tile([0.0, 0.0, -speed], (len(x), 1))

    return make


def few(count: int, apart: float) -> Begin:
    """So many particles, `apart` spacings from each other, where the column has its middle."""

    def make(simulation: Simulation, generator: np.random.Generator) -> Start:
        x, _ = column(simulation, generator)
        d = simulation.scene.discretization.spacing
        middle = x[np.linalg.norm(x - x.mean(axis=0), axis=1).argmin()]
        x = middle + np.outer(np.arange(count), [apart * d, 0.0, 0.0])
        return x, np.zeros_like(x)

    return make


def pair_at_a_tenth(simulation: Simulation, generator: np.random.Generator) -> Start:
    """A sinking column in which one particle stands a tenth of a spacing from another."""
    x, v = sinking(simulation, generator)
    i = int(np.linalg.norm(x - x.mean(axis=0), axis=1).argmin())
    j = int(np.argsort(np.linalg.norm(x - x[i], axis=1))[1])
    x[j] = x[i] + [0.1 * simulation.scene.discretization.spacing, 0.0, 0.0]
    return x, v


def one_is_fast(simulation: Simulation, generator: np.random.Generator) -> Start:
    """A sinking column in which one particle is ten times as fast, and goes sideways."""
    x, v = sinking(simulation, generator)
    i = int(np.linalg.norm(x - x.mean(axis=0), axis=1).argmin())
    v[i] = 10.0 * np.linalg.norm(v[i]) * np.array([0.6, 0.0, 0.8])
    return x, v


def hole(simulation: Simulation, generator: np.random.Generator) -> Start:
    """A sinking column with a hole of two spacings' radius."""
    x, v = sinking(simulation, generator)
    d = simulation.scene.discretization.spacing
    keep = np.linalg.norm(x - x.mean(axis=0), axis=1) > 2.0 * d
    return x[keep], v[keep]


def one_is_nan(simulation: Simulation, generator: np.random.Generator) -> Start:
    """A sinking column in which one velocity is not a number."""
    x, v = sinking(simulation, generator)
    v[len(v) // 2, 0] = np.nan
    return x, v


# What must hold at the end, beside the rules


def stands(trial: Trial) -> str:
    """Blood that has come to rest stays so: 2 % of the scene's speed."""
    v = trial.pour.simulation.velocities().astype(float)
    speed = math.sqrt((v**2).sum(axis=1).mean())
    limit = 0.02 * (trial.pour.simulation.derived.expected_speed or 1.0)
    return f"still moves at {speed:.2g} m/s" if speed > limit else ""


def falls(trial: Trial) -> str:
    """What is alone falls freely, to a fifth of a spacing (a long step is ahead by g t T/2)."""
    simulation = trial.pour.simulation
    x, v = trial.start
    gravity = np.asarray(simulation.scene.gravity)
    expected = (x + v * trial.case.until + 0.5 * gravity * trial.case.until**2).mean(axis=0)
    found = simulation.positions()
    if len(found) != len(x):
        return "left the vessel"
    apart = np.linalg.norm(found.mean(axis=0) - expected)
    apart /= simulation.scene.discretization.spacing
    return f"{apart:.2g} spacings from free fall" if apart > 0.2 else ""


def coasts(trial: Trial) -> str:
    """Blood in uniform motion keeps its form: 5 % of its speed."""
    v = trial.pour.simulation.velocities().astype(float)
    _, before = trial.start
    mean = before.mean(axis=0)
    speed = math.sqrt(((v - mean) ** 2).sum(axis=1).mean()) / np.linalg.norm(mean)
    return f"velocities spread by {100 * speed:.0f} %" if speed > 0.05 else ""


CHANNEL = ("aortoiliac", 1.2e-3, 0.010)
"""The scene of most cases: some 900 particles."""
AORTA = shipped(*CHANNEL)
TANK = shipped("box", 2e-3)
WEIGHTLESS = shipped("box", 2e-3, 0.04, 0.0, gravity=(0.0, 0.0, 0.0))

CASES: tuple[Case, ...] = (
    Case("rest, no gravity", WEIGHTLESS, 0.46, check=stands),
    Case("standing column", TANK, 0.46, check=stands),
    Case("lone particle", AORTA, 0.03, few(1, 0.0), falls),
    Case("two in contact", AORTA, 0.03, few(2, 0.6), falls),
    Case("uniform motion", WEIGHTLESS, 0.01, ball(0.5), coasts),
    Case("turned scene", turned(*CHANNEL), 0.15),
    Case("step x 0.5", AORTA, 0.15, step=0.5),
    Case("step x 2", AORTA, 0.15, step=2.0),
    Case("step x 4", AORTA, 0.15, step=4.0),
    Case("spacing x 0.75", AORTA, 0.15, spacing=0.75),
    Case("spacing x 1.25", AORTA, 0.15, spacing=1.25),
    Case("low column", shipped("aortoiliac", 1.2e-3, 0.004), 0.15),
    Case("high column", shipped("aortoiliac", 1.2e-3, 0.022), 0.15),
    Case("portal vein", shipped("portal_vein", 8e-4, 0.006), 0.3),
    Case("carotid siphon", shipped("carotid_siphon", 4.4e-4, 0.006), 0.15),
    Case("narrowed by 50 %", narrowed(50.0, 8e-4, 0.008), 0.15),
    Case("narrowed by 75 %", narrowed(75.0, 6e-4, 0.005), 0.15),
    Case("jet, 1 x speed", WEIGHTLESS, 0.03, ball(0.9)),
    Case("jet, 2 x speed", WEIGHTLESS, 0.03, ball(1.8)),
    Case("jet, 4 x speed", WEIGHTLESS, 0.03, ball(3.6)),
    Case("pair at 0.1 d", AORTA, 0.05, pair_at_a_tenth),
    Case("one at 10 x speed", AORTA, 0.05, one_is_fast),
    Case("hole", AORTA, 0.05, hole),
    Case("one NaN", AORTA, 0.05, one_is_nan, dies_well="not finite"),
    Case("standing, 1000 x", TANK, 4.6, check=stands),
)

METHODS: tuple[Method, ...] = (
    Method("physics", "physics"),
    Method("physics, 2 x step", "physics", step_factor=2.0),
    Method("physics, c = 3 U", "physics", sound_speed_ratio=3.0),
    SOFT,
    Method("physics, printed integrator", "physics", integrator="paper"),
    Method("implicit", "implicit", "implicit"),
    Method("implicit, 0 rounds", "implicit", "implicit", rounds=0),
    Method("pcnet", "pcnet", "pcnet"),
)


@dataclass(frozen=True)
class Row:
    """A method from one start of a case."""

    method: str
    case: str
    start: int
    survived: float
    """Part of the case's time; 1 if it lived."""
    died: str
    """Empty, or why."""
    leaks: int
    """Most at a frame."""
    compression: float
    """Largest 99th percentile."""
    drained: float
    """Part that left, at the end."""
    wall_corrections: int
    fallback_share: float


@dataclass(frozen=True)
class Job:
    """What a process of its own is told."""

    method: Method
    case: int
    starts: int
    arch: str


def measure(job: Job) -> list[Row]:
    """A method in a case, from all starts; needs a process of its own."""
    from taichi_sph.runtime import start

    start(job.arch, "f32", 1)
    case = CASES[job.case]
    with tempfile.TemporaryDirectory() as folder:
        base = case.scene(Path(folder))
        stretched = (job.method.step_factor or 1.0) * case.step
        method = replace(
            job.method, spacing=job.method.spacing * case.spacing, step_factor=stretched
        )
        scene = method.scene(base)
        simulation = Simulation.from_scene(scene, method.maker(scene))
    filled = simulation.positions().astype(float)
    return [_trial(simulation, filled, job, k) for k in range(job.starts)]


def _trial(simulation: Simulation, filled: np.ndarray, job: Job, k: int) -> Row:
    """From one start."""
    case, generator = CASES[job.case], np.random.default_rng(k)
    simulation.restart_with(filled, np.zeros_like(filled))
    x, v = (case.begin or column)(simulation, generator)
    if k:
        d = simulation.scene.discretization.spacing
        x = x + JITTER * d * generator.uniform(-1.0, 1.0, x.shape)
    simulation.restart_with(x, np.nan_to_num(v))
    if np.isnan(v).any():  # what a user may not give, and a model must not survive
        simulation.particles.replace({"identity": np.arange(len(x)), "position": x, "velocity": v})
    interval = case.until / FRAMES
    pour = TimedRun(job.method.name, simulation, Trace(interval), rules=RULES)
    for frame in range(1, FRAMES + 1):
        pour.frame(frame * interval)
        if pour.death or pour.empty:
            break
    death = pour.death
    if not death and case.check is not None:
        death = case.check(Trial(pour, (x, v), case))
    if case.dies_well:
        death = "" if case.dies_well in death else death or f"did not stop: {case.dies_well}"
    trace = pour.trace
    return Row(
        method=job.method.name,
        case=case.name,
        start=k,
        survived=len(trace.drained) / FRAMES if pour.death and death else 1.0,
        died=death,
        leaks=pour.most_leaks,
        compression=max(trace.compression, default=0.0),
        drained=trace.drained[-1] if trace.drained else 0.0,
        wall_corrections=simulation.wall_corrections,
        fallback_share=simulation.fallback_share,
    )


def wilson(alive: int, trials: int) -> tuple[float, float]:
    """95 % interval of a fraction (Wilson 1927)."""
    z = 1.96
    centre = (alive + 0.5 * z**2) / (trials + z**2)
    half = z / (trials + z**2) * math.sqrt(alive * (trials - alive) / trials + 0.25 * z**2)
    return max(0.0, centre - half), min(1.0, centre + half)


def main(
    out: Path,
    starts: int,
    quick: bool,
    only: str,
    weights: Sequence[Path],
    processes: int,
    plot: Path | None,
    arch: str,
) -> None:
    """Measure what is not yet in `out`, print who died where and why, and draw it.

    Raises:
        InputError: weights cannot be used, `out` holds something else, or `only` fits nothing.
    """
    rows = read_rows(out, Row)
    methods = [*METHODS]
    for path in weights:
        method = of_weights(path)
        methods.append(method)
        if "direct" in method.name:
            methods.append(replace(method, name=f"{method.name}, no guard", guarded=False))
    asked = [
        (method, k)
        for k, case in enumerate(CASES)
        for method in methods
        if only in f"{method.name}, {case.name}"
        and not (quick and (case.until > QUICK or method.name not in MODELS))
    ]
    if not asked:
        raise InputError(
            f'--only {only}: no "METHOD, CASE" has this; methods are '
            f"{'; '.join(m.name for m in methods)}; cases are {'; '.join(c.name for c in CASES)}"
        )
    there = {(row.method, row.case) for row in rows}
    jobs = [
        Job(method, k, 1 if quick else starts, arch)
        for method, k in asked
        if (method.name, CASES[k].name) not in there
    ]
    context = multiprocessing.get_context("spawn")
    # Taichi frees no field: a process for each job.
    with context.Pool(processes, maxtasksperchild=1) as pool:
        for done, found in enumerate(pool.imap_unordered(measure, jobs), 1):
            rows += found
            write_rows(out, rows)
            lived = sum(not row.died for row in found)
            print(
                f"{found[0].case}, {found[0].method}: {lived} of {len(found)} live "
                f"({done} of {len(jobs)})",
                file=sys.stderr,
            )
    print_table(rows)
    if plot is not None:
        draw(rows, plot)


QUICK = 0.2
"""Longest case of --quick [s]; it has only what `run --model` takes."""


def cell(rows: Sequence[Row], method: str, case: str) -> list[Row]:
    """All starts of a method in a case."""
    return [row for row in rows if (row.method, row.case) == (method, case)]


def methods_of(rows: Sequence[Row]) -> list[str]:
    """Methods in the order of METHODS, then the others."""
    found = list(dict.fromkeys(row.method for row in rows))
    known = [method.name for method in METHODS if method.name in found]
    return known + sorted(name for name in found if name not in known)


def cases_of(rows: Sequence[Row]) -> list[str]:
    """Cases in the order of CASES."""
    found = {row.case for row in rows}
    return [case.name for case in CASES if case.name in found]


def print_table(rows: Sequence[Row]) -> None:
    """How many live, with the interval, and each death with its reason."""
    found = table("who lives", "method", "alive", "95 %", "leaks", "worst compression")
    for name in methods_of(rows):
        mine = [row for row in rows if row.method == name]
        alive = sum(not row.died for row in mine)
        low, high = wilson(alive, len(mine))
        living = [row for row in mine if not row.died]
        found.add_row(
            name,
            f"{alive}/{len(mine)}",
            f"{100 * low:.0f}-{100 * high:.0f} %",
            str(sum(row.leaks for row in living)),
            f"{100 * max((row.compression for row in living), default=math.nan):.1f} %",
        )
    console().print(found)
    for name in methods_of(rows):
        for case in cases_of(rows):
            mine = cell(rows, name, case)
            dead = [row for row in mine if row.died]
            if dead:
                console().print(
                    f"{name}, {case}: {len(mine) - len(dead)}/{len(mine)} live; "
                    f"{dead[0].died} at {100 * dead[0].survived:.0f} %",
                    soft_wrap=True,
                )


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the matrix, and how many live over time."""
    import matplotlib
    from matplotlib.figure import Figure

    methods, cases = methods_of(rows), cases_of(rows)
    figure = Figure(
        figsize=(0.62 * len(cases) + 4.0, 0.4 * len(methods) + 6.2), layout="constrained"
    )
    matrix, curves = figure.subplots(2, 1, height_ratios=[0.4 * len(methods) + 1.5, 4.0])
    grid = np.full((len(methods), len(cases)), np.nan)
    for i, method in enumerate(methods):
        for j, case in enumerate(cases):
            mine = cell(rows, method, case)
            if not mine:
                continue
            grid[i, j] = np.mean([not row.died for row in mine])
            worst = 100.0 * max(row.compression for row in mine)
            leaks = max(row.leaks for row in mine)
            text = f"{worst:.0f}" + (f"\n{leaks}!" if leaks else "")
            matrix.text(j, i, text, ha="center", va="center", fontsize=7)
    matrix.imshow(grid, cmap="RdYlGn", vmin=0.0, vmax=1.0, aspect="auto", alpha=0.75)
    matrix.set_yticks(range(len(methods)), methods)
    matrix.set_xticks(range(len(cases)), cases, rotation=50, ha="right", fontsize=8)
    matrix.set_title("green: all starts live; number: compression [%], and leaks with a mark")
    curves.set_prop_cycle(color=matplotlib.colormaps["tab20"].colors)  # type: ignore[attr-defined]
    for method in methods:
        trials = sum(row.method == method for row in rows)
        ended = [row.survived for row in rows if row.method == method and row.died]
        time = [0.0, *sorted(t for t in ended if t < 1.0), 1.0]
        alive = [1.0 - sum(t <= now for t in ended) / trials for now in time[:-1]]
        alive.append(1.0 - len(ended) / trials)
        curves.step(time, [100.0 * a for a in alive], where="post", label=method)
    curves.set(
        xlabel="part of the case's time", ylabel="alive [%]", ylim=(0.0, 102.0), xlim=(0.0, 1.0)
    )
    curves.legend(frameon=False, fontsize=8, loc="lower left", ncols=2)
    figure.savefig(path, dpi=110)
