"""`vesselflow validate`: the physics against theory, one table, each row with its tolerance."""

import cmath
import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import taichi as ti
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from app.files import check_plots, console
from app.validation import analytic, flows
from app.validation import boundary_cases as operations
from app.validation.flows import DENSITY, Liquid, State, state_of
from app.validation.report import Curve, Report, Row, relative_l2
from taichi_sph.errors import InputError, RunError
from taichi_sph.fluid.rheology import Casson, Newtonian
from taichi_sph.motion import Motion
from taichi_sph.particles.smoothing_kernel import WendlandC2
from taichi_sph.runtime import start

VISCOSITY = 3.5e-3
"""Of Newtonian blood [Pa s]."""

GRAVITY = 9.81
"""[m/s^2]."""

MACH = 10.0
"""Sound speed over the largest speed, the scenes' default."""

BACKGROUND = 2.0
"""Background pressure of flows without a free surface [rho U^2]: the least that keeps the pressure
above zero everywhere.  Particles under pressure resist shear like grains, so it must be small."""


@dataclass(frozen=True)
class Case:
    """A group of rows that one setting of Taichi serves."""

    name: str
    title: str
    precision: str
    run: Callable[[Report, bool], None]
    """Takes the report and whether to be quick."""


def watched(
    motion: Motion,
    times: list[float],
    report: Report,
    begin: float,
    end: float,
    axial_force: Callable[[float], float] | None = None,
) -> Iterator[int]:
    """Advance to each time, telling progress between two fractions; yields the index.

    A force per mass along z [m/s^2] that changes with time [s] is set before each step.
    """
    for k, target in enumerate(times):
        while motion.time < target * (1.0 - 1e-12):
            if axial_force is not None:
                motion.gravity = (0.0, 0.0, axial_force(motion.time))
            motion.step(target - motion.time)
            if motion.steps % 50 == 0:
                report.advance(begin + (end - begin) * motion.time / times[-1])
        motion.time = target
        yield k


# --- kernel ---------------------------------------------------------------------------------------


@ti.kernel
def sample_kernel(kernel: ti.template(), r: ti.template(), w: ti.template(), slope: ti.template()):
    """The kernel as the sums use it.  Writes: w, slope."""
    for i in r:
        w[i] = kernel.w(r[i])
        slope[i] = kernel.slope(r[i])


def kernel_integrals(report: Report, quick: bool) -> None:
    """Integrals of W and of its gradient by Gauss and Legendre's rule, exact for polynomials."""
    kernel = WendlandC2(2e-3)
    nodes, weights = np.polynomial.legendre.leggauss(16)
    radii = 0.5 * kernel.support_radius * (nodes + 1.0)
    shell = 2.0 * math.pi * kernel.support_radius * weights * radii**2
    r, w, slope = (ti.field(float, len(radii)) for _ in range(3))
    r.from_numpy(radii)
    sample_kernel(kernel, r, w, slope)
    report.compare("kernel: integral of W", float(shell @ w.to_numpy()), 1.0, 1e-12)
    # int x dW/dx dV = -1 makes the gradient of a linear field exact.
    gradient = -float(shell @ (slope.to_numpy() * radii**2)) / 3.0
    report.compare("kernel: integral of -x dW/dx", gradient, 1.0, 1e-12)


# --- hydrostatics ---------------------------------------------------------------------------------


def hydrostatic(report: Report, quick: bool) -> None:
    """A column at rest on a floor: pressure, compression, and that it comes to rest."""
    layers, d = (40 if quick else 60), 1e-3
    fill = layers * d
    c = MACH * math.sqrt(2.0 * GRAVITY * fill)
    liquid = Liquid(Newtonian(VISCOSITY), c, d, artificial_viscosity=0.05)
    motion = flows.column(liquid, layers, GRAVITY)
    swing = 4.0 * fill / c  # period of the column's slowest sound
    scale = GRAVITY * fill
    first, left = 0.0, 0.0
    for _ in watched(motion, list(swing * np.arange(1, 9) / 16.0), report, 0.0, 0.2):
        first = max(first, 0.5 * float(np.square(state_of(motion).velocity).sum(axis=1).mean()))
    # That sound would ring for 10^5 d/c.  Stopping the blood a quarter period after rest, when a
    # tone passes through its equilibrium, takes the energy out of it: the deepest tone and its
    # overtones in turn, twice.
    for overtone in (1, 3, 5, 7, 9, 11, 13) * 2:
        motion.particles.velocity.fill(0.0)
        motion.advance_to(motion.time + 0.25 * swing / overtone)
        report.advance(0.2 + 0.4 * (1.0 - 1.0 / overtone))
    motion.particles.velocity.fill(0.0)
    begin = motion.time
    for _ in watched(motion, list(begin + swing * np.arange(1, 9) / 8.0), report, 0.6, 1.0):
        left = max(left, 0.5 * float(np.square(state_of(motion).velocity).sum(axis=1).mean()))
    state = state_of(motion)
    height = analytic.hydrostatic_height(fill, GRAVITY, DENSITY, c)
    z = state.position[:, 2]
    pressure = flows.pressure_of(state.density, liquid.fluid().equation_of_state)
    theory = analytic.hydrostatic_pressure(height - z, GRAVITY, DENSITY, c)
    report.add(
        f"hydrostatic column {layers} d high: pressure, L2 over particles",
        f"{pressure.max():.5g} Pa at foot", f"{theory.max():.5g} Pa",
        relative_l2(pressure, theory), 0.02,
    )  # fmt: skip
    compression = state.density.max() / DENSITY - 1.0
    foot = analytic.hydrostatic_density(np.array(height), GRAVITY, DENSITY, c) / DENSITY - 1.0
    report.add(
        "hydrostatic column: largest compression (error: the compression)",
        f"{compression:.3%}", f"{float(foot):.3%}", compression, 0.01,
    )  # fmt: skip
    deep = z < 0.8 * height
    slope, offset = np.polyfit(z[deep], pressure[deep], 1)
    level = -offset / slope
    report.add(
        "hydrostatic column: level of zero pressure (error: spacings)",
        f"{level / d:.2f} d", f"{height / d:.2f} d", abs(level - height) / d, 1.0,
    )  # fmt: skip
    report.add(
        "hydrostatic column: kinetic energy/(m g H), first swing to rest (error: what is left)",
        f"{first / scale:.1e} to {left / scale:.1e}", "0", left / scale, 1e-5,
    )  # fmt: skip
    order = np.argsort(z)
    report.draw(
        "hydrostatic", "height [m]", "pressure [Pa]",
        Curve(f"{layers} spacings", z[order], pressure[order], z[order], theory[order]),
    )  # fmt: skip


# --- pipe flows -----------------------------------------------------------------------------------


def axial(state: State) -> tuple[np.ndarray, np.ndarray]:
    """Distance from the axis [m] and speed along it [m/s] of each particle."""
    return np.hypot(state.position[:, 0], state.position[:, 1]), state.velocity[:, 2]


RADIUS = 1e-3
"""Of the tube [m]."""
REYNOLDS = 6.0
"""Of the Poiseuille flow; sound and viscosity then limit the step alike at 20 across."""
START_UP = (0.1, 0.3, 1.0)
"""Times of the start-up profiles [R^2/nu]; at 1 the flow is steady to 0.4 %."""


def poiseuille(report: Report, quick: bool) -> None:
    """Start-up, steady profile and refinement in a round tube."""
    nu = VISCOSITY / DENSITY
    speed = REYNOLDS * nu / (2.0 * RADIUS)
    drive = 4.0 * VISCOSITY * speed / RADIUS**2
    diffusion = RADIUS**2 / nu
    finest = 20 if quick else 40
    errors: dict[int, float] = {}

    def liquid(across: int) -> Liquid:
        return Liquid(
            Newtonian(VISCOSITY), MACH * speed, 2.0 * RADIUS / across,
            background_pressure=BACKGROUND * DENSITY * speed**2,
        )  # fmt: skip

    def theory(r: np.ndarray, fraction: float) -> np.ndarray:
        return analytic.pipe_start_up(r, fraction * diffusion, RADIUS, drive, VISCOSITY, DENSITY)

    work = {10: 0.02, 20: 0.13, 40: 0.7}
    done, total = 0.0, sum(work[a] for a in work if a <= finest) + (0 if quick else 0.13)
    for across in (a for a in work if a <= finest):
        motion = flows.tube(liquid(across), RADIUS, drive)
        begin, done = done / total, done + work[across]
        detailed = across == 20
        fractions = [*START_UP, *(() if quick else (1.5,))] if detailed else [1.0]
        times = [f * diffusion for f in fractions]
        for k in watched(motion, times, report, begin, done / total):
            r, u = axial(state_of(motion))
            exact = theory(r, fractions[k])
            error = relative_l2(u, exact)
            if fractions[k] == 1.0:
                errors[across] = error
            if detailed:
                steady = fractions[k] > 1.0
                name = "steady profile" if steady else f"start-up at {fractions[k]:g} R^2/nu"
                report.add(
                    f"Poiseuille, 20 across: {name}, L2 over particles",
                    f"mean {u.mean() / speed:.4f} U", f"{exact.mean() / speed:.4f} U", error, 0.05,
                )  # fmt: skip
                line = np.linspace(0.0, RADIUS, 200)
                report.draw(
                    "poiseuille", "r/R", "u/U",
                    Curve(f"t = {fractions[k]:g} R²/nu", r / RADIUS, u / speed,
                          line / RADIUS, theory(line, fractions[k]) / speed),
                )  # fmt: skip
    if not quick:
        motion = flows.tube(liquid(20), RADIUS, drive, ordered=False)
        for _ in watched(motion, [diffusion], report, done / total, 1.0):
            r, u = axial(state_of(motion))
        report.add(
            "Poiseuille, 20 across, blood disordered: at 1 R^2/nu, L2 over particles",
            f"mean {u.mean() / speed:.4f} U", f"{theory(r, 1.0).mean() / speed:.4f} U",
            relative_l2(u, theory(r, 1.0)), 0.05,
        )  # fmt: skip
    tried = sorted(errors)
    improved = all(errors[b] < errors[a] for a, b in pairwise(tried))
    order = -float(np.polyfit(np.log(tried), np.log([errors[a] for a in tried]), 1)[0])
    listed = ", ".join(f"{errors[a]:.2%} at {a}" for a in tried)
    report.add(
        "Poiseuille: L2 falls under refinement (error: the finest)",
        listed, "falling", errors[tried[-1]] if improved else math.inf, 0.05,
    )  # fmt: skip
    # The wall is one layer of proxies whose distance is known to some hundredths of a spacing, so
    # first order is what can be asked.
    report.add(
        "Poiseuille: order of convergence (error: 1 - order)",
        f"{order:.2f}", "1", max(0.0, 1.0 - order), 0.5,
    )  # fmt: skip


WOMERSLEY = 4.0
"""Of an artery 5.4 mm across at 70 beats a minute."""
PULSES = 4
"""Periods from rest; what is left of the start is then below 0.1 %."""
PHASES = 40
"""Samples of a period; eight of them are held against the profile."""


def harmonic(time: np.ndarray, values: np.ndarray, frequency: float) -> complex:
    """Return the complex amplitude A of Re{A e^(i w t)} + constant by least squares."""
    turn = frequency * time
    basis = np.column_stack([np.cos(turn), -np.sin(turn), np.ones_like(turn)])
    real, imaginary, _ = np.linalg.lstsq(basis, values, rcond=None)[0]
    return complex(real, imaginary)


def womersley(report: Report, quick: bool) -> None:
    """Pulsating flow in a round tube, from rest: amplitude and phase, and the profile."""
    across, tolerance = (10, 0.1) if quick else (20, 0.05)
    nu = VISCOSITY / DENSITY
    speed = REYNOLDS * nu / (2.0 * RADIUS)
    frequency = nu * (WOMERSLEY / RADIUS) ** 2
    period = 2.0 * math.pi / frequency
    constants = (frequency, VISCOSITY, DENSITY)
    line = np.linspace(0.0, RADIUS, 200)

    # Everything is proportional to the drive: the one that makes the largest speed U.
    in_phase, behind = (
        analytic.pipe_pulsation(line, time, RADIUS, 1.0, *constants) for time in (0.0, period / 4.0)
    )
    drive = speed / float(np.hypot(in_phase, behind).max())

    def theory(r: np.ndarray, time: float) -> np.ndarray:
        return analytic.pipe_pulsation(r, time, RADIUS, drive, *constants)

    def force(time: float) -> float:
        return drive / DENSITY * math.cos(frequency * time)

    liquid = Liquid(
        Newtonian(VISCOSITY), MACH * speed, 2.0 * RADIUS / across,
        background_pressure=BACKGROUND * DENSITY * speed**2,
    )  # fmt: skip
    motion = flows.tube(liquid, RADIUS, drive)
    times = [(PULSES - 2 + (k + 1) / PHASES) * period for k in range(2 * PHASES)]
    means, computed, expected = [], [], []
    for k in watched(motion, times, report, 0.0, 1.0, force):
        r, u = axial(state_of(motion))
        means.append(float(u.mean()))
        sample = k + 1 - PHASES  # of the last period
        if sample > 0 and sample % (PHASES // 8) == 0:
            computed.append(u)
            expected.append(theory(r, times[k]))
        if sample > 0 and sample % (PHASES // 4) == 0:
            report.draw(
                "womersley", "r/R", "u/U",
                Curve(f"t = {sample / PHASES:g} T", r / RADIUS, u / speed,
                      line / RADIUS, theory(line, times[k]) / speed),
            )  # fmt: skip
    flow = math.pi * RADIUS**2 * np.array(means)
    before, found = (
        harmonic(np.array(times)[part], flow[part], frequency)
        for part in (slice(PHASES), slice(PHASES, None))
    )
    exact = analytic.pipe_pulsation_flow_rate(RADIUS, drive, *constants)
    where = f"Womersley, Wo {WOMERSLEY:g}, {across} across"
    report.compare(
        f"{where}: amplitude of the flow rate (still changing {abs(found / before - 1.0):.1%})",
        abs(found) * 1e9, abs(exact) * 1e9, tolerance, "mm^3/s",
    )  # fmt: skip
    lag, lag_exact = -cmath.phase(found), -cmath.phase(exact)
    report.add(
        f"{where}: lag of the flow rate behind the force (error: radians)",
        f"{lag:.4f} rad", f"{lag_exact:.4f} rad", abs(lag - lag_exact), tolerance,
    )  # fmt: skip
    u, v = np.concatenate(computed), np.concatenate(expected)
    report.add(
        f"{where}: speed at 8 phases, L2 over particles",
        f"rms {math.sqrt(np.square(u).mean()) / speed:.4f} U",
        f"{math.sqrt(np.square(v).mean()) / speed:.4f} U",
        relative_l2(u, v), tolerance,
    )  # fmt: skip


@dataclass(frozen=True)
class CassonPipe:
    """A pipe flow of Casson blood."""

    name: str
    law: Casson
    shear_rate: float
    """At the wall, by the ideal law [1/s]."""
    radius: float
    """[m]."""

    @property
    def beta(self) -> float:
        """Plug radius over pipe radius."""
        return analytic.plug_ratio(self.shear_rate, self.law.eta, self.law.tau_y)

    @property
    def drive(self) -> float:
        """G [Pa/m]."""
        return 2.0 * self.law.tau_y / (self.beta * self.radius)

    @property
    def settling(self) -> float:
        """Time after which the flow is steady [s]: R^2/nu at the wall's viscosity."""
        stress = 0.5 * self.drive * self.radius
        return self.radius**2 * DENSITY * self.shear_rate / stress


CASSON_PIPES = (
    CassonPipe("Casson, blood", Casson(3.5e-3, 5e-3, 7.0), 100.0, 0.5e-3),
    # Boyd et al. 2007, doi:10.1063/1.2772250, in a slow vein: the plug is plain to see.
    CassonPipe("Casson, plug", Casson(0.055**2, 0.1937**2, 7.0), 8.0, 3e-3),
)


def casson(report: Report, quick: bool) -> None:
    """Profile and flow rate of Casson blood at two yield stresses and two resolutions."""
    pipes, resolutions = (CASSON_PIPES[:1], (10,)) if quick else (CASSON_PIPES, (10, 20))
    runs = [(pipe, across) for pipe in pipes for across in resolutions]
    cost = [across**4 for _, across in runs]
    done = np.concatenate([[0], np.cumsum(cost)]) / sum(cost)
    errors: dict[str, list[float]] = {}
    for number, (pipe, across) in enumerate(runs):
        law = pipe.law
        line, exact, rate = analytic.generalised_pipe(
            pipe.radius,
            pipe.drive,
            partial(analytic.regularised_casson, eta=law.eta, tau_y=law.tau_y, n=law.n),
        )
        speed = float(exact[0])
        liquid = Liquid(
            law, MACH * speed, 2.0 * pipe.radius / across,
            background_pressure=BACKGROUND * DENSITY * speed**2,
        )  # fmt: skip
        motion = flows.tube(liquid, pipe.radius, pipe.drive)
        before = 0.0
        times = [0.9 * pipe.settling, pipe.settling]
        for k in watched(motion, times, report, done[number], done[number + 1]):
            r, u = axial(state_of(motion))
            if k == 0:
                before = float(u.mean())
        drift = abs(u.mean() / before - 1.0)
        there = np.interp(r, line, exact)
        ideal = analytic.casson_pipe_speed(r, pipe.radius, pipe.drive, law.eta, law.tau_y)
        error = relative_l2(u, there)
        errors.setdefault(pipe.name, []).append(error)
        where = f"{pipe.name} (beta {pipe.beta:.2g}), {across} across"
        report.add(
            f"{where}: profile, L2 (to the ideal law {relative_l2(u, ideal):.1%}; "
            f"still changing {drift:.1%})",
            f"centre {u[r < 0.15 * pipe.radius].mean() * 1e3:.4g} mm/s", f"{speed * 1e3:.4g} mm/s",
            error, 0.05 if across >= 20 else 0.1,
        )  # fmt: skip
        area = math.pi * pipe.radius**2
        ideal_rate = analytic.casson_pipe_flow_rate(pipe.radius, pipe.drive, law.eta, law.tau_y)
        flow = float(u.mean()) * area
        report.add(
            f"{where}: flow rate (ideal law {ideal_rate * 1e9:.4g} mm^3/s)",
            f"{flow * 1e9:.4g} mm^3/s", f"{rate * 1e9:.4g} mm^3/s",
            abs(flow / rate - 1.0), 0.05 if across >= 20 else 0.1,
        )  # fmt: skip
        report.draw(
            f"{pipe.name.lower().replace(', ', '-')}", "r/R", "u [m/s]",
            Curve(f"{across} across", r / pipe.radius, u, line / pipe.radius, exact),
        )  # fmt: skip
    for name, pair in errors.items():
        if len(pair) > 1:
            report.add(
                f"{name}: L2 falls under refinement (error: the finer)",
                f"{pair[0]:.2%} to {pair[1]:.2%}", "falling",
                pair[1] if pair[1] < pair[0] else math.inf, 0.05,
            )  # fmt: skip


# --- viscosity ------------------------------------------------------------------------------------


def shear_wave(report: Report, quick: bool) -> None:
    """Viscosity delivered to a wave of 32 spacings, by both viscous forms."""
    d, waves = 1e-4, 32
    nu = VISCOSITY / DENSITY
    k = 2.0 * math.pi / (waves * d)
    rate = analytic.shear_wave_rate(k, VISCOSITY, DENSITY)
    speed = 0.02 * d * rate  # so slow that the lattice stays one: the sum alone is judged

    def velocity(x: np.ndarray) -> np.ndarray:
        return np.column_stack([speed * np.sin(k * x[:, 2]), 0.0 * x[:, 0], 0.0 * x[:, 0]])

    for number, (form, nested) in enumerate((("pairwise", False), ("nested", True))):
        liquid = Liquid(Newtonian(VISCOSITY), 20.0 * nu / d, d, nested=nested)
        motion = flows.box(liquid, (flows.SLAB, flows.SLAB, waves), velocity)
        for _ in watched(motion, [1.0 / rate], report, number / 2, (number + 1) / 2):
            state = state_of(motion)
        amplitude = 2.0 * (state.velocity[:, 0] * np.sin(k * state.position[:, 2])).mean()
        delivered = -math.log(amplitude / speed) * VISCOSITY
        report.compare(
            f"shear wave, 32 d long, {form}: delivered viscosity",
            delivered * 1e3, VISCOSITY * 1e3, 0.05, "mPa s",
        )  # fmt: skip


def taylor_green(report: Report, quick: bool) -> None:
    """Energy decay of Taylor and Green's vortices, at the default and at a wider support."""
    n, reynolds, speed = 32, 10.0, 0.01
    nu = VISCOSITY / DENSITY
    length = reynolds * nu / speed
    rate = analytic.taylor_green_energy_rate(length, nu)

    def velocity(x: np.ndarray) -> np.ndarray:
        u, v = analytic.taylor_green(x[:, 0], x[:, 1], 0.0, length, speed, nu)
        return np.column_stack([u, v, 0.0 * u])

    for number, ratio in enumerate((2.0, 2.4)):
        liquid = Liquid(
            Newtonian(VISCOSITY), MACH * speed, length / n, support_ratio=ratio,
            # The vortices' own pressure falls to -rho U^2/2.
            background_pressure=0.6 * DENSITY * speed**2,
        )  # fmt: skip
        motion = flows.box(liquid, (n, n, flows.SLAB), velocity)
        energy = np.square(state_of(motion).velocity).sum()
        for _ in watched(motion, [1.0 / rate], report, number / 2, (number + 1) / 2):
            state = state_of(motion)
        measured = -math.log(np.square(state.velocity).sum() / energy) * rate
        report.compare(
            f"Taylor-Green, Re {reynolds:g}, 32 across, R = {ratio:g} d: decay of the energy",
            measured, rate, 0.05, "1/s",
        )  # fmt: skip


def momentum(report: Report, quick: bool) -> None:
    """Total momentum of blood in violent motion in a closed box, double precision."""
    d, n = 1e-3, 10
    generator = np.random.default_rng(1)
    liquid = Liquid(
        Casson(3.5e-3, 5e-3, 7.0), 1.0, d, background_pressure=50.0, artificial_viscosity=0.05
    )

    def velocity(x: np.ndarray) -> np.ndarray:
        return generator.normal(0.0, 0.05, x.shape)

    motion = flows.box(liquid, (n, n, n), velocity, jitter=0.1)
    before = state_of(motion).velocity
    for k in range(200):
        motion.step(flows.FAR)
        report.advance(k / 200)
    after = state_of(motion).velocity
    drift = np.abs((after - before).sum(axis=0)).max() / np.linalg.norm(before, axis=1).sum()
    report.add(
        "momentum, 200 steps, f64: drift over sum of m |v|", f"{drift:.1e}", "0", drift, 1e-12
    )


# --- free surface ---------------------------------------------------------------------------------


def dam_break(report: Report, quick: bool) -> None:
    """Front of a collapsing column against Martin and Moyce's experiment."""
    across = 12 if quick else 20
    width = 0.05715
    d = width / across
    c = MACH * math.sqrt(2.0 * GRAVITY * 2.0 * width)
    liquid = Liquid(Newtonian(1e-3), c, d, artificial_viscosity=0.05)
    motion = flows.dam(liquid, across, 5.0, GRAVITY)
    scaled = np.arange(0.2, 2.61, 0.2)
    fronts = []
    unit = math.sqrt(0.5 * width / GRAVITY)
    for _ in watched(motion, list(scaled * unit), report, 0.0, 1.0):
        x = np.sort(state_of(motion).position[:, 0])
        fronts.append((x[-flows.SLAB :].mean() + 0.5 * d) / width)  # one row across the slab
    measured = analytic.collapse_front(scaled)
    late = scaled > 1.0
    report.add(
        f"dam break, column {across} wide: front, L2 from t sqrt(2g/a) = 1.2 to 2.6",
        f"x/a {fronts[-1]:.3f} at {scaled[-1]:.1f}", f"{measured[-1]:.3f} (measured)",
        relative_l2(np.array(fronts)[late], measured[late]), 0.1,
    )  # fmt: skip
    report.draw(
        "dam-break", "t sqrt(2g/a)", "x/a",
        Curve(f"{across} wide", scaled, np.array(fronts),
              np.array(analytic.COLLAPSE_TIME), np.array(analytic.COLLAPSE_FRONT), "measured"),
    )  # fmt: skip


CASES = (
    Case("kernel", "kernel integrals", "f64", kernel_integrals),
    Case("momentum", "momentum in a closed box", "f64", momentum),
    Case("shear_wave", "shear wave", "f32", shear_wave),
    Case("taylor_green", "Taylor-Green vortices", "f32", taylor_green),
    Case("hydrostatic", "hydrostatic column", "f32", hydrostatic),
    Case("poiseuille", "Poiseuille flow in a tube", "f32", poiseuille),
    Case("womersley", "Womersley flow in a tube", "f32", womersley),
    Case("casson", "Casson blood in a tube", "f32", casson),
    Case("dam_break", "dam break", "f32", dam_break),
    Case("account", "pump and reservoir", "f32", operations.account),
    Case("pulse", "a wall that pulses", "f32", operations.pulse),
    Case("wound", "bleeding from a wound", "f32", operations.wound),
    Case("tool", "sphere in a tank", "f32", operations.tool),
)


def run_case(
    case: Case,
    quick: bool = False,
    arch: str = "cpu",
    threads: int | None = None,
    advance: Callable[[float], None] = lambda fraction: None,
) -> Report:
    """Run one case; Taichi starts anew, so that the fields of the case before are freed.

    A diverged run is a row that misses, not the end of the others.
    """
    start(arch, case.precision, threads)
    report = Report(advance)
    try:
        case.run(report, quick)
    except RunError as error:
        report.add(f"{case.title}: {error}", "diverged", "", math.nan, 0.0)
    return report


def table_of(rows: list[Row]) -> Table:
    """The table as it is printed."""
    table = Table(title="computed against theory")
    for heading in ("quantity", "computed", "theory"):
        table.add_column(heading, overflow="fold")
    for heading in ("error", "tolerance", "", "wall s"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(
            row.quantity, row.computed, row.theory,
            f"{row.error:.2%}" if row.error >= 1e-4 else f"{row.error:.1e}",
            f"{row.tolerance:.0%}" if row.tolerance >= 1e-2 else f"{row.tolerance:.0e}",
            "[green]pass[/]" if row.passed else "[bold red]MISS[/]", f"{row.seconds:.1f}",
        )  # fmt: skip
    return table


def draw_pictures(report: Report, folder: Path) -> list[Path]:
    """Draw a case's profiles, one file each."""
    from matplotlib.figure import Figure

    files = []
    for name, (x_label, y_label, curves) in report.pictures.items():
        figure = Figure(figsize=(6.4, 4.4), layout="constrained")
        axes = figure.add_subplot()
        for k, curve in enumerate(curves):
            axes.plot(curve.x, curve.computed, ".", ms=2, color=f"C{k}", label=curve.label)
            axes.plot(
                curve.theory_x, curve.theory, "-", lw=1, color="black",
                label=None if k else curve.source,
            )  # fmt: skip
        axes.set(xlabel=x_label, ylabel=y_label, title=name)
        axes.legend(markerscale=4)
        files.append(folder / f"{name}.png")
        figure.savefig(files[-1], dpi=130)
    return files


def main(
    only: list[str] | None = None,
    plot: Path | None = None,
    quick: bool = False,
    arch: str = "cpu",
    threads: int | None = None,
) -> int:
    """Run the cases, print the table and, if asked, draw the profiles.

    Args:
        only: names of cases; all by default.
        plot: folder for pictures, made if it is not there.
        quick: coarser and fewer, under a minute on two cores.
        arch: "cpu" or "gpu".
        threads: CPU threads.

    Returns:
        0 if every row is within its tolerance, else 1.

    Raises:
        InputError: an unknown case, or pictures that cannot be drawn.
    """
    names = [case.name for case in CASES]
    unknown = [name for name in only or () if name not in names]
    if unknown:
        raise InputError(f"--only {unknown[0]}: allowed are {', '.join(names)}")
    if plot is not None:
        check_plots(plot)
    rows: list[Row] = []
    files: list[Path] = []
    progress = Progress(
        TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(),
        console=Console(file=sys.stderr), transient=True,
    )  # fmt: skip
    begin = time.perf_counter()
    with progress:
        for case in (c for c in CASES if not only or c.name in only):
            task = progress.add_task(case.title, total=1.0)

            def advance(fraction: float, task: TaskID = task) -> None:
                progress.update(task, completed=fraction)

            report = run_case(case, quick, arch, threads, advance)
            progress.remove_task(task)
            rows += report.rows
            if plot is not None:
                files += draw_pictures(report, plot)
    terminal = console()
    terminal.print(table_of(rows))
    missed = sum(not row.passed for row in rows)
    terminal.print(
        f"{len(rows) - missed} of {len(rows)} rows within tolerance, "
        f"{time.perf_counter() - begin:.0f} s"
    )
    for file in files:
        terminal.print(f"picture {file}", soft_wrap=True)
    return 1 if missed else 0
