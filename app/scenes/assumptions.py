"""What a new scene assumes: gravity, the spacing of its blood, the depth of its column."""

import math
from dataclasses import replace

from taichi_sph.geometry.mesh import Floats
from taichi_sph.geometry.vessel import LEAST_ACROSS, Vessel
from taichi_sph.scene import Column

ACROSS, LEAST = 8.0, 6.0
"""Particles across the narrowest place that a new scene aims at, and makes do with."""
FEWEST, MOST = 3000, 6000
"""Blood particles that a new scene aims at."""
TOO_MANY = 100_000
"""Blood particles of a column, above which the opening that asks for them is capped: a frame of
80 000 takes some 15 s on two cores."""
DEEP = 2.5
"""Depth of a new scene's column, over its opening's radius."""
FILLED = 0.9
"""Part of a tube's volume that the lattice fills, about: it keeps half a spacing from the wall."""


def choose_gravity(vessel: Vessel, notes: list[str]) -> Floats:
    """Straight into the first opening [m/s^2], (3,): at an angle blood runs out of its rim."""
    top, *others = vessel.openings
    notes.append(f"gravity: assumed straight into {top.name}")
    slack = 1e-3 * top.radius
    above = [o.name for o in others if (o.centre - top.centre) @ top.normal > -slack]
    if above:
        notes.append(
            f"gravity: {', '.join(above)} then lies no lower than {top.name}: blood "
            "does not run out of it by itself; set gravity, or drive an opening"
        )
    return -9.81 * top.normal


def _round_down(value: float) -> float:
    """Two significant digits."""
    digits = 1 - math.floor(math.log10(value))
    return float(f"{math.floor(value * 10**digits + 1e-9) / 10**digits:.12g}")


def _a_radius_deep(vessel: Vessel, spacing: float) -> float:
    """Particles of a column as deep as its opening's radius, about."""
    top = vessel.openings[0]
    return FILLED * top.area * top.radius / spacing**3


def _spacing_for(vessel: Vessel) -> float:
    """Distance between particles that suits a vessel's openings [m]."""
    spacing = vessel.narrowest / ACROSS
    # A wide opening above a narrow way: coarser, or the column would be a mere film; a vessel
    # without narrow places: finer, or it would be a handful of particles.
    coarse = (2.0 * _a_radius_deep(vessel, 1.0) / MOST) ** (1 / 3)
    fine = (DEEP * _a_radius_deep(vessel, 1.0) / FEWEST) ** (1 / 3)
    spacing = min(max(spacing, coarse), vessel.narrowest / LEAST, fine)
    if _a_radius_deep(vessel, spacing) > MOST:
        # So thin a branch beside so thick a vessel: as few across as can be resolved.
        spacing = min(coarse, vessel.narrowest / (1.02 * LEAST_ACROSS))
    return _round_down(spacing)


def _without(vessel: Vessel, name: str) -> Vessel:
    """The vessel with an opening capped."""
    openings = tuple(replace(o, is_open=o.is_open and o.name != name) for o in vessel.openings)
    return replace(vessel, openings=openings)


def _cap_too_thin(vessel: Vessel, spacing: float | None, notes: list[str]) -> Vessel:
    """Cap openings that are too thin for the spacing or, without one, that ask for too fine a one.

    The first opening and one more stay open.
    """
    while sum(o.is_open for o in vessel.openings) > 2:
        thinnest = vessel.narrowest_opening
        step = _spacing_for(vessel) if spacing is None else spacing
        count = _a_radius_deep(vessel, step)
        if spacing is None and count > TOO_MANY:
            reason = f"the column would be of some {count:.2g} blood particles with it"
        elif spacing is not None and vessel.narrowest / spacing < LEAST_ACROSS:
            reason = f"{vessel.narrowest / spacing:.1f} particles across it are too few"
        else:
            break
        if thinnest is None or thinnest.name == vessel.openings[0].name:
            break
        vessel = _without(vessel, thinnest.name)
        notes.append(
            f"warning: {thinnest.name}, of radius {1e3 * thinnest.radius:.3g} mm, is written as "
            f'capped: {reason}; state = "open" with a spacing of at most '
            f"{2e3 * thinnest.radius / LEAST_ACROSS:.2g} mm opens it"
        )
    return vessel


def choose_column(
    vessel: Vessel, spacing: float | None, notes: list[str]
) -> tuple[Vessel, float, float]:
    """The vessel with its thinnest openings capped where need be, spacing and column's height [m].

    Raises:
        InputError: the spacing given is too coarse, or no column fits.
    """
    top = vessel.openings[0]
    vessel = _cap_too_thin(vessel, spacing, notes)
    reason = "chosen" if spacing is None else "as given"
    step = _spacing_for(vessel) if spacing is None else spacing
    vessel.require_resolution(step)
    across = vessel.narrowest / step
    notes.append(
        f"spacing: {1e3 * step:.3g} mm, {reason}: {across:.1f} particles across the narrowest "
        f"place ({1e3 * vessel.narrowest:.3g} mm)"
    )
    # As deep as a little over the opening is wide, within the bounds; at any rate one radius.
    radius_deep = _a_radius_deep(vessel, step)
    wanted = round(min(max(min(DEEP * radius_deep, MOST), FEWEST, radius_deep), TOO_MANY))
    room = vessel.column_room(Column(opening=top.name, particles=wanted), step)
    while room.volume < (1.0 - 1e-6) * wanted * step**3 and wanted >= 100:
        wanted //= 2
        room = vessel.column_room(Column(opening=top.name, particles=wanted), step)
    height = float(f"{max(1, round(room.height / step)) * step:.6g}")
    column = Column(opening=top.name, height=height)
    vessel.fill_column(column, step)  # it fits, or says why not
    count = round(vessel.column_room(column, step).volume / step**3)
    notes.append(
        f"column: {count} blood particles, {1e3 * height:.3g} mm deep, at {top.name}, the largest"
    )
    if count > 2 * MOST:
        thinnest = vessel.narrowest_opening or top
        way_out = f'state = "capped" in [openings.{thinnest.name}] and a coarser spacing'
        way_out = "a coarser --spacing" if spacing is not None else f"{way_out}, or --spacing"
        notes.append(
            f"warning: {count} blood particles, where {FEWEST} to {MOST} are aimed at: the "
            f"narrowest place, {1e3 * vessel.narrowest:.3g} mm at {thinnest.name}, sets the "
            f"spacing; {way_out}, makes them fewer"
        )
    return vessel, step, height
