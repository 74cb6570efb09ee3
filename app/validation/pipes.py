"""Cases of flow in a round tube: start-up, pulsation, and blood with a yield stress."""

import cmath
import math
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from app.validation import analytic, flows
from app.validation.flows import BACKGROUND, DENSITY, MACH, VISCOSITY, Liquid, State, state_of
from app.validation.report import Curve, Report, relative_l2, watched
from taichi_sph.fluid.rheology import Casson, Newtonian


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


STEADY = (
    (100, 4, 0.15, ""),
    (100, 6, 0.10, ""),
    (100, 8, 0.07, ""),
    (100, 20, 0.05, ""),
    (500, 20, 0.05, ""),
)
"""Reynolds number of the largest speed, spacings across, tolerance of the flow rate, known miss."""
WATCHED = 0.5
"""Time after which a steady flow is looked at [R^2/nu]: of a start that is wrong 6 % is left."""


def steady_pipe(report: Report, quick: bool) -> None:
    """Flow rate of a steady Newtonian flow at a closed scene's pressure and sound speed.

    It begins as it should be, from a lattice that is cut to the tube and filled up at random, and
    drifts to what its viscosity makes of the drive.
    """
    nu = VISCOSITY / DENSITY
    diffusion = RADIUS**2 / nu
    cases = STEADY[:3] if quick else STEADY
    work = [reynolds * across**4 for reynolds, across, *_ in cases]
    for number, (reynolds, across, tolerance, known) in enumerate(cases):
        speed = reynolds * nu / (2.0 * RADIUS)
        liquid = Liquid.closed(speed, 2.0 * RADIUS / across)
        motion = flows.tube(liquid, RADIUS, 4.0 * VISCOSITY * speed / RADIUS**2, ordered=False)
        flows.set_velocity(motion, partial(parabola, speed=speed))
        done, all_of_it = sum(work[:number]), sum(work)
        end = (done + work[number]) / all_of_it
        for _ in watched(motion, [WATCHED * diffusion], report, done / all_of_it, end):
            _, u = axial(state_of(motion))
        flow = math.pi * RADIUS**2 * float(u.mean())
        report.add(
            f"Poiseuille at Re {reynolds}, {across} across, disordered: flow rate",
            f"{1e9 * flow:.4g} mm^3/s", f"{1e9 * 0.5 * math.pi * RADIUS**2 * speed:.4g} mm^3/s",
            abs(flow / (0.5 * math.pi * RADIUS**2 * speed) - 1.0), tolerance, known,
        )  # fmt: skip


def parabola(x: np.ndarray, speed: float) -> np.ndarray:
    """Velocity (n, 3) [m/s] of steady flow at positions (n, 3) [m], of a largest speed [m/s]."""
    r2 = (x[:, 0] ** 2 + x[:, 1] ** 2) / RADIUS**2
    return np.column_stack([0.0 * r2, 0.0 * r2, speed * (1.0 - r2)])


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


def pulsating_drive(speed: float, frequency: float) -> float:
    """Amplitude of the drive [Pa/m] that makes a largest speed [m/s] at an angular frequency [1/s].

    Everything is proportional to the drive.
    """
    line = np.linspace(0.0, RADIUS, 200)
    in_phase, behind = (
        analytic.pipe_pulsation(line, time, RADIUS, 1.0, frequency, VISCOSITY, DENSITY)
        for time in (0.0, 0.5 * math.pi / frequency)
    )
    return speed / float(np.hypot(in_phase, behind).max())


def womersley(report: Report, quick: bool) -> None:
    """Pulsating flow in a round tube, from rest: amplitude and phase, and the profile."""
    across, tolerance = (10, 0.1) if quick else (20, 0.05)
    nu = VISCOSITY / DENSITY
    speed = REYNOLDS * nu / (2.0 * RADIUS)
    frequency = nu * (WOMERSLEY / RADIUS) ** 2
    period = 2.0 * math.pi / frequency
    constants = (frequency, VISCOSITY, DENSITY)
    line = np.linspace(0.0, RADIUS, 200)
    drive = pulsating_drive(speed, frequency)

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
