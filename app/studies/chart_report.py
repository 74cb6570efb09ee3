"""Tables and the picture of the chart: error over cost, and which methods nothing beats."""

import math
import statistics
from collections.abc import Sequence
from pathlib import Path

from app.files import console, percent, table
from app.studies.chart import Row
from app.studies.methods import CURVES, DISCRETISATION_FLOOR, OTHER_NETWORKS

ALIKE = 1e-3
"""Errors below this tell no method from another."""
PANELS = {
    "drained": "drained part, largest error [%]",
    "field": "momentum on a coarse grid, mean error [%]",
    "energy": "kinetic energy, largest error [%]",
    "compression": "compression, 99th percentile [%]",
}


def pareto_front(rows: Sequence[Row], error: str) -> list[Row]:
    """Rows that live and that nothing living beats in both cost and error, cheapest first."""
    best, found = math.inf, []
    for row in sorted((r for r in rows if not r.died), key=lambda r: r.normalised_cost):
        if getattr(row, error) < best:
            best = getattr(row, error)
            found.append(row)
    return found


def cheapest_equivalents(rows: Sequence[Row], model: str, error: str) -> list[tuple[Row, Row]]:
    """Each living row of a model with the cheapest one of the others that is as good."""
    found = []
    mine = [row for row in rows if row.curve.startswith(model) and not row.died]
    others = [row for row in rows if not row.curve.startswith(model) and not row.died]
    for row in mine:
        as_good = [other for other in others if getattr(other, error) <= getattr(row, error)]
        if as_good:
            found.append((row, min(as_good, key=lambda other: other.normalised_cost)))
    return found


def _cost_or_last(row: Row) -> float:
    """What a row is sorted by: those without a cost come last."""
    return row.normalised_cost if math.isfinite(row.normalised_cost) else math.inf


def print_tables(rows: Sequence[Row]) -> None:
    """All rows, and each scene's front, for people."""
    unit = statistics.median(row.yardstick for row in rows) if rows else 1.0
    for scene in dict.fromkeys(row.scene for row in rows):
        mine = [row for row in rows if row.scene == scene]
        found = table(
            f"{scene}, {mine[0].until:g} s: errors against half the spacing",
            "method", "blood", "steps", "wall s / s", *PANELS, "leaks", "died", left=("died",),
        )  # fmt: skip
        for row in sorted(mine, key=_cost_or_last):
            name = row.method
            if row.step_factor != 1.0:
                name += f" ({row.step_factor:.3g} x)"
            found.add_row(
                name,
                str(row.blood_particles),
                str(row.steps),
                f"{unit * row.normalised_cost:.3g}",
                *(percent(getattr(row, error), 2) for error in PANELS),
                str(row.leaks),
                f"{row.died} at {100 * row.survived:.0f} %" if row.died else "",
            )
        console().print(found)
        usable = [row for row in mine if row.method != DISCRETISATION_FLOOR.name]
        for error, label in PANELS.items():
            names = ", ".join(row.method for row in pareto_front(usable, error))
            console().print(f"front, {label.partition(',')[0]}: {names}")
            for model in ("pcnet", "implicit"):
                for row, rival in cheapest_equivalents(usable, model, error):
                    ratio = rival.normalised_cost / row.normalised_cost
                    console().print(f"  {row.method}: {ratio:.2f} times faster than {rival.method}")


def network_verdict(rows: Sequence[Row], error: str) -> str:
    """How the network stands where it stands best, against the cheapest that is as good."""
    errors = [getattr(row, error) for row in rows if not row.died]
    known = [e for e in errors if math.isfinite(e)]
    if errors and not known:
        return "the blood is at rest"
    if max(known, default=0.0) < ALIKE:
        return f"all agree to {100 * ALIKE:g} %"
    pairs = cheapest_equivalents(rows, "pcnet", error)
    best = pareto_front(rows, error)
    alone = [row for row in best if row.curve.startswith("pcnet")]
    if not alone:
        return "PcNet is not on the front"
    ratios = [rival.normalised_cost / row.normalised_cost for row, rival in pairs if row in alone]
    if not ratios:
        return "PcNet on the front"
    return f"PcNet on the front: up to {max(ratios):.2g} x the next as good"


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw error over cost, a row of panels a scene."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    unit = statistics.median(row.yardstick for row in rows)
    scenes = list(dict.fromkeys(row.scene for row in rows))
    figure = Figure(figsize=(4.4 * len(PANELS), 4.2 * len(scenes) + 1.0), layout="constrained")
    grid = figure.subplots(len(scenes), len(PANELS), squeeze=False)
    curves = list(dict.fromkeys(row.curve for row in rows if row.curve))
    spare = iter(OTHER_NETWORKS)
    colours = {curve: CURVES.get(curve) or next(spare, OTHER_NETWORKS[-1]) for curve in curves}
    for line, scene in zip(grid, scenes, strict=True):
        mine = [row for row in rows if row.scene == scene]
        floor = next((row for row in mine if row.method == DISCRETISATION_FLOOR.name), None)
        usable = [row for row in mine if row is not floor]
        for axes, (error, label) in zip(line, PANELS.items(), strict=True):
            for curve in curves:
                points = [row for row in usable if row.curve == curve]
                if curve in ("physics, sound speed", "implicit, rounds"):
                    # The plain model is a point of these curves too.
                    plain = curve.partition(",")[0]
                    points = [row for row in usable if row.method == plain] + points
                alive = [row for row in points if not row.died]
                x = [unit * row.normalised_cost for row in alive]
                y = [100.0 * getattr(row, error) for row in alive]
                style = "o:" if curve == "ballistic" else "o-"
                axes.plot(x, y, style, color=colours[curve], ms=5, label=curve)
                for row in points:
                    if row.died and math.isfinite(row.normalised_cost):
                        # What it got wrong until it died says nothing.
                        axes.plot(
                            unit * row.normalised_cost, 0.97, "o", mfc="none", ms=7,
                            color=colours[curve], transform=axes.get_xaxis_transform(),
                        )  # fmt: skip
            axes.axvline(1.0, color="grey", lw=1, ls=":")
            if floor is not None and error != "compression":
                axes.axhline(100.0 * getattr(floor, error), color="grey", lw=1, ls="--")
            axes.set(xscale="log", ylabel=label)
            axes.margins(y=0.15)
            # At rest some errors are none, or relative to nothing: no place on a logarithm.
            is_logarithmic = any(getattr(row, error) > 0.0 for row in usable if not row.died)
            if is_logarithmic:
                axes.set_yscale("log")
            for axis in (axes.xaxis, axes.yaxis)[: 1 + is_logarithmic]:
                axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
                axis.set_major_formatter(StrMethodFormatter("{x:g}"))
                axis.set_minor_formatter(NullFormatter())
            name = f"{scene}: " if error == "drained" else ""
            axes.set_title(f"{name}{network_verdict(usable, error)}", fontsize=9)
            axes.set_xlabel("wall seconds for a simulated second")
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    figure.suptitle(
        "left and low is better; hollow at the top: died; dotted: real time; dashed: what the "
        "reference is worth"
    )
    figure.savefig(path, dpi=110)
