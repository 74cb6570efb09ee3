"""`vesselflow advise`: the cheapest method that meets an error budget on a scene.

The error of a pour is mostly its spacing's, and each scene has its own.  So the scene is poured at
several spacings by the models that take long steps, and the differences are carried on to a pour at
half the spacing with an error of first order (Roache, J. Fluids Eng. 116, 1994).  How the other
methods stand to these, in error and in cost, is taken from the chart; how surely they live, from
the stability cases.  What is advised has been poured on the scene itself.
"""

import math
import statistics
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rich.table import Table

from app.files import read_rows, table
from app.jobs.process import in_own_process
from app.studies.cases import CASES
from app.studies.chart import Job, Row, check_end, main, run_timed
from app.studies.methods import CHARTED, METHODS, TESTED, Method
from app.studies.stability import Row as StabilityRow
from app.studies.timed_run import RULES, Trace, errors_of, is_at_rest, require_falling
from taichi_sph.errors import InputError, RunError
from taichi_sph.scene import NewtonianTable, Scene

EVIDENCE = Path(__file__).parent / "evidence"
"""Folder of the chart and the stability cases that advice is taken from."""
MEASURES = {
    "drained": "the drained part",
    "energy": "the kinetic energy",
    "field": "the momentum on a coarse grid",
}
"""What an error budget may be of: errors of the chart that a spacing has."""
OF_BLOOD_AT_REST = ("drained",)
"""Measures that mean something where the blood stays where it is."""
AT_REST = "\nThe blood stays where it is: nothing is said of its kinetic energy and momentum."
DEFAULT = ("drained", "energy")
"""What it is of if nobody says."""
PROBED = ("implicit, 0 rounds", "pcnet, spacing")
"""Curves of the chart that are poured if they are safe; other methods are judged by the first."""
SAFE = 0.95
"""Part of the starts of the stability cases that a method must have lived through."""


@dataclass(frozen=True)
class Probe:
    """A pour of the scene."""

    method: Method
    spacing: float
    """[m]"""
    blood_particles: int
    until: float
    """[s]"""
    died: str
    narrowest: float
    """Diameter of the largest ball that passes [m]."""
    wall_per_simulated: float
    """Wall seconds for a simulated second."""
    trace: Trace


@dataclass(frozen=True)
class Candidate:
    """A method on a scene, as far as can be known before."""

    method: Method
    error: float
    """Largest of those asked for, against a pour at half the spacing."""
    wall_per_simulated: float
    """Wall seconds for a simulated second."""
    rejected_because: str = ""
    """Why it is not advised, if it is not."""


@dataclass(frozen=True)
class Advice:
    """What a scene needs, and why."""

    method: Method
    candidates: list[Candidate]
    """Cheapest first."""
    text: str


def probe(job: Job) -> Probe:
    """Pour a scene; needs a process of its own."""
    run, _ = run_timed(job, RULES)
    derived, spacing = run.simulation.derived, run.simulation.scene.discretization.spacing
    return Probe(
        method=job.method,
        spacing=spacing,
        blood_particles=derived.blood_particles,
        until=job.until,
        died=run.failure,
        narrowest=run.simulation.vessel.narrowest,
        wall_per_simulated=run.wall_per_simulated,
        trace=run.trace,
    )


def expected(apart: dict[float, float]) -> dict[float, float]:
    """Errors against half the spacing [-], by relative spacing, from those against spacing 1.

    An error of C s leaves C (s - 1) between two pours: C by least squares, and C/2 is the error at
    spacing 1.  Coarser ones have what was seen beside it, as two errors that know nothing of each
    other.  NaN if nothing coarser was poured.
    """
    weight = sum((s - 1.0) ** 2 for s in apart)
    rise = sum(e * (s - 1.0) for s, e in apart.items()) / weight if weight else math.nan
    return {s: math.hypot(e, 0.5 * rise) for s, e in ({1.0: 0.0} | apart).items()}


def ratio(
    rows: Sequence[Row], variants: Sequence[Method], base: dict[float, str], value: str
) -> float:
    """What methods are to those of a base at the same spacing: a geometric mean over the chart.

    Args:
        rows: the chart.
        variants: the methods.
        base: names of the others by relative spacing.
        value: which figure of a row.

    Returns:
        NaN if no scene has both.
    """
    figures = {(row.scene, row.method): getattr(row, value) for row in rows if not row.died}
    found = [
        figures[scene, method.name] / figures[scene, base[method.spacing]]
        for scene in dict.fromkeys(row.scene for row in rows)
        for method in variants
        if figures.get((scene, method.name), 0.0) > 0.0
        and figures.get((scene, base.get(method.spacing, "")), 0.0) > 0.0
    ]
    return statistics.geometric_mean(found) if found else math.nan


def advisable() -> list[Method]:
    """Methods that may be advised: charted, with a step of their own, and tested for stability."""
    tested = {method.setting for method in TESTED}
    return [method for method in CHARTED if method.setting in tested]


def survival(runs: Sequence[StabilityRow], method: Method) -> tuple[int, int]:
    """Starts that a method lived through, of those that the textbook's physics lives through.

    Cases at another step than a method's own are left out: `run` never takes one.
    """
    name = next(tested.name for tested in TESTED if tested.setting == method.setting)
    own = {case.name for case in CASES if case.step == 1.0}
    bearable = {
        (row.case, row.start)
        for row in runs
        if row.method == "physics" and not row.died and row.case in own
    }
    mine = [r for r in runs if r.method == name and (r.case, r.start) in bearable]
    return sum(not row.died for row in mine), len(mine)


def unsafe(method: Method, runs: Sequence[StabilityRow]) -> str:
    """What the stability cases say against a method; empty if nothing."""
    good, starts = survival(runs, method)
    if good < SAFE * starts or not starts:
        return f"lived through {good} of {starts} starts that the physics lives through"
    return ""


def errors_here(
    probes: Sequence[Probe], rows: Sequence[Row], measures: Sequence[str]
) -> dict[str, dict[str, float]]:
    """Errors expected of what was poured and lived, by method and measure."""
    errors: dict[str, dict[str, float]] = {}
    for curve in PROBED:
        alive = {p.method.spacing: p for p in probes if p.method.curve == curve and not p.died}
        if 1.0 not in alive:
            continue
        apart = {s: errors_of(p.trace, alive[1.0].trace) for s, p in alive.items() if s != 1.0}
        for measure in measures:
            found = expected({s: getattr(e, measure) for s, e in apart.items()})
            for s, error in found.items():
                name = alive[s].method.name
                if math.isnan(error):  # nothing coarser fits the vessel: the worst of the chart
                    charted = [getattr(r, measure) for r in rows if r.method == name]
                    error = max(charted, default=math.nan)
                errors.setdefault(name, {})[measure] = error
    return errors


def candidates(
    probes: Sequence[Probe],
    rows: Sequence[Row],
    runs: Sequence[StabilityRow],
    measures: Sequence[str],
) -> list[Candidate]:
    """All listed methods at the spacings poured, cheapest first."""
    poured = {p.method.name: p for p in probes}
    errors = errors_here(probes, rows, measures)
    base = {m.spacing: m.name for m in METHODS if m.curve == PROBED[0]}
    result = []
    for method in advisable():
        own, like = poured.get(method.name), poured.get(base[method.spacing])
        if own is not None:
            mine, cost = errors.get(method.name, {}), own.wall_per_simulated
        elif like is not None and not like.died:
            variants = [m for m in CHARTED if m.setting == method.setting]
            shares = {m: ratio(rows, variants, base, m) for m in measures}
            mine = {
                m: e if math.isnan(shares[m]) else e * shares[m]
                for m, e in errors.get(like.method.name, {}).items()
            }
            cost = ratio(rows, [method], base, "normalised_cost") * like.wall_per_simulated
        else:
            continue
        error = max(mine.values(), default=math.nan)
        result.append(Candidate(method, error, cost, reason(method, own, rows, runs)))
        if math.isnan(error + cost) and not result[-1].rejected_because:
            result[-1] = replace(result[-1], rejected_because="not on the chart")
    return sorted(result, key=lambda c: (math.isnan(c.wall_per_simulated), c.wall_per_simulated))


def reason(
    method: Method, own: Probe | None, rows: Sequence[Row], runs: Sequence[StabilityRow]
) -> str:
    """Why a method is not fit; empty if it is.  `own` is its pour of the scene, if there is one."""
    if own is not None and own.died:
        return f"died here: {own.died}"
    died = [row for row in rows if row.method == method.name and row.died]
    if own is None and died:
        return f"died on the chart ({died[0].scene}: {died[0].died})"
    return unsafe(method, runs)


def choose(found: Sequence[Candidate], error: float, slowest: float) -> Candidate:
    """The cheapest that meets an error and a cost [wall s a simulated s].

    Where none meets both: the most exact within the cost, else the cheapest within the error.

    Raises:
        RunError: none is fit.
    """
    fit = [c for c in found if not c.rejected_because]
    if not fit:
        raise RunError("advise: no listed method is fit for this scene")
    quick = [c for c in fit if c.wall_per_simulated <= slowest]
    exact = [c for c in fit if c.error <= error]
    both = [c for c in quick if c in exact]
    if quick and not both:
        return min(quick, key=lambda c: c.error)
    return min(both or exact or fit, key=lambda c: c.wall_per_simulated)


def yield_sentence(scene: Scene, narrowest: float) -> str:
    """Whether the scene needs Casson's law: the yield stress against the wall's.

    tau_w = rho g R / 2 of blood that falls through the narrowest place; the flow of Casson blood
    over Newtonian of the same eta is 1 - 16/7 b^1/2 + 4/3 b - b^4/21, b = tau_y / tau_w (Fung,
    Biomechanics: Mechanical Properties of Living Tissues, section 3.3).
    """
    rheology = scene.blood.rheology
    if isinstance(rheology, NewtonianTable):
        return "The blood is Newtonian: it has no yield stress."
    wall = 0.25 * scene.blood.density * math.hypot(*scene.gravity) * narrowest
    b = rheology.yield_stress / wall if wall > 0.0 else math.inf
    if not b < 1.0:
        return "Casson's law is needed: without gravity or an opening the wall's stress is unknown."
    flow = 16.0 / 7.0 * math.sqrt(b) - 4.0 / 3.0 * b + b**4 / 21.0
    need = "matters" if flow > 0.1 else "matters little"
    return (
        f"Casson's law {need}: the yield stress is {100 * b:.2g} % of the wall's, Newtonian blood "
        f"would flow {100 * flow:.2g} % faster."
    )


def explain(
    scene: Scene,
    chosen: Candidate,
    shown: Probe,
    found: Sequence[Candidate],
    error: float,
    measures: Sequence[str],
    slowest: float,
) -> str:
    """The advice in a few sentences, with its figures."""
    d = scene.discretization.spacing
    budget = f"{100 * error:.3g} %"
    if slowest < math.inf:
        budget += f" and {1.0 / slowest:.3g} x real time"
    within = chosen.error <= error and shown.wall_per_simulated <= slowest
    verdict = "is the cheapest within" if within else "is nearest, for nothing listed is within"
    lines = [
        f"{scene.name}: {chosen.method.name}, {shown.blood_particles} particles at "
        f"{1e3 * shown.spacing:.3g} mm, {verdict} {budget}.",
        f"Expected: {' and '.join(MEASURES[m] for m in measures)} off by about "
        f"{100 * chosen.error:.2g} % from a pour at {1e3 * d / 2:.3g} mm. Poured here to "
        f"{shown.until:g} s it lives, compressed by {100 * max(shown.trace.compression):.1f} % "
        f"at most, for {shown.wall_per_simulated:.3g} s a simulated s "
        f"({1.0 / shown.wall_per_simulated:.2g} x real time).",
    ]
    for c in found:
        if (
            c.rejected_because
            and c.error <= error
            and c.wall_per_simulated < chosen.wall_per_simulated
        ):
            lines.append(f"Cheaper, but not advised: {c.method.name} ({c.rejected_because}).")
            break
    wanted = d * (0.5 + error / chosen.error * (chosen.method.spacing - 0.5)) if chosen.error else d
    if chosen.error > error and wanted > 0.55 * d:
        lines.append(f"A scene with a spacing of {1e3 * wanted:.2g} mm might be within it.")
    slow = 100 * statistics.fmean(shown.trace.slow)
    lines += [
        yield_sentence(scene, shown.narrowest),
        f"On average {slow:.2g} % of the blood is at rest: letting it sleep could save no more.",
    ]
    return "\n".join(lines)


def advise(
    scene: Scene,
    error: float,
    measures: Sequence[str],
    real_time: float | None,
    until: float,
    arch: str,
    threads: int | None,
) -> Advice:
    """Pour the scene at several spacings, choose, and pour what was chosen.

    Raises:
        InputError: the scene cannot be poured, or the time is too short.
        RunError: nothing lives.
    """
    require_falling(scene, "advise")
    check_end(scene, until)

    def look(method: Method) -> Probe:
        shown = in_own_process(probe, Job(scene, method, until, None, arch, threads))
        state = shown.died or f"{shown.wall_per_simulated:.3g} s a simulated s"
        print(f"{scene.name}, {method.name}: {state}", file=sys.stderr)
        return shown

    rows = read_rows(EVIDENCE / "chart.csv", Row)
    runs = read_rows(EVIDENCE / "stability.csv", StabilityRow)
    probes: list[Probe] = []
    plain = [m for m in METHODS if m.curve in PROBED and not unsafe(m, runs)]
    for method in sorted(plain, key=lambda m: -m.spacing):  # cheap first
        try:
            probes.append(look(method))
        except InputError:  # too coarse for the vessel, say
            if method.spacing == 1.0:
                raise
    rests = any(is_at_rest(p.trace) for p in probes if p.method.spacing == 1.0 and not p.died)
    known = [m for m in measures if not rests or m in OF_BLOOD_AT_REST]
    if not known:
        raise InputError(
            f"advise: the blood of {scene.name} stays where it is for {until:g} s, so nothing can "
            "be said of its motion; ask for the drained part, or for a longer time"
        )
    found = candidates(probes, rows, runs, known)
    slowest = 1.0 / real_time if real_time else math.inf
    while True:
        chosen = choose(found, error, slowest)
        seen = [p for p in probes if p.method == chosen.method]
        shown = seen[0] if seen else look(chosen.method)
        if not shown.died:
            break
        found[found.index(chosen)] = replace(chosen, rejected_because=f"died here: {shown.died}")
    text = explain(scene, chosen, shown, found, error, known, slowest)
    if rests:
        text += AT_REST
    return Advice(chosen.method, found, text)


def candidates_table(scene: Scene, advice: Advice) -> Table:
    """All listed methods, cheapest first, for people."""
    shown = table(
        f"{scene.name}: what is listed", "method", "spacing [mm]", "wall s / s", "x real time",
        "error expected [%]", "", left=("",),
    )  # fmt: skip
    for c in advice.candidates:
        shown.add_row(
            c.method.name,
            f"{1e3 * c.method.spacing * scene.discretization.spacing:.3g}",
            _known(c.wall_per_simulated, ".3g"),
            _known(1.0 / c.wall_per_simulated, ".2g"),
            _known(100.0 * c.error, ".2g"),
            "advised" if c.method == advice.method else c.rejected_because,
        )
    return shown


def _largest_error(row: Row, measures: Sequence[str]) -> float:
    """The largest of the errors asked for that there are."""
    errors = [getattr(row, measure) for measure in measures]
    return max((e for e in errors if math.isfinite(e)), default=0.0)


def _known(value: float, form: str) -> str:
    """A figure for people; a dash where there is none."""
    return format(value, form) if math.isfinite(value) else "-"


def check_advice(
    scene: Scene,
    advice: Advice,
    error: float,
    measures: Sequence[str],
    until: float,
    out: Path,
    arch: str,
    threads: int | None,
) -> str:
    """Measure what is listed against a pour at half the spacing, and say whether the advice holds.

    Raises:
        InputError: `out` holds something else.
        RunError: the pour at half the spacing died.
    """
    methods = [candidate.method for candidate in advice.candidates]
    rows = main([scene], until, out, methods, arch, threads)
    names = {
        candidate.method.name for candidate in advice.candidates if not candidate.rejected_because
    }
    mine = [row for row in rows if (row.scene, row.until) == (scene.name, until)]
    found = {row.method: _largest_error(row, measures) for row in mine if not row.died}
    row = next(row for row in mine if row.method == advice.method.name)
    if row.died:
        return f"Checked: {row.method} died: {row.died}."
    within = "within" if found[row.method] <= error else "beyond"
    better = [
        other
        for other in sorted(mine, key=lambda other: other.normalised_cost)
        if other.method in names & set(found)
        and other.normalised_cost < row.normalised_cost
        and found[other.method] <= error
    ]
    text = f"Checked: {row.method} is off by {100 * found[row.method]:.2g} %, {within} the budget; "
    if not better:
        return text + "no cheaper one that is fit is within it."
    costs = ", ".join(
        f"{other.method} ({100 * found[other.method]:.2g} %, "
        f"{row.normalised_cost / other.normalised_cost:.2g} times cheaper)"
        for other in better
    )
    return text + f"cheaper and within it: {costs}."
