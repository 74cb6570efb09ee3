"""Findings: what there is to say of a surface before blood is poured into it."""

from dataclasses import dataclass

import numpy as np

from taichi_sph.geometry import mesh
from taichi_sph.geometry.mesh import Floats
from taichi_sph.geometry.surface_file import where
from taichi_sph.geometry.vessel import Vessel
from taichi_sph.geometry.wall_sampling import WallSample

LARGEST_RADIUS = 0.05
"""No opening of a vessel is wider [m]: an aneurysm of the aorta that has to be mended has half."""
LARGEST_VOLUME = 1e-3
"""And no lumen holds more [m^3]: the whole aorta holds a quarter of it."""
BEYOND = 2.5
"""Blood beyond an opening's plane has left by it within so many radii of its middle."""
STEEPEST = 30.0
"""Gravity farther off the way into the column's opening is said [degrees]: the top of the column
then stands out of the opening by more than half its radius, and runs out."""


@dataclass(frozen=True)
class Finding:
    """One line of the check of a surface."""

    good: bool
    text: str


def text_of(place: Floats) -> str:
    """A place [m] as text in millimetres, to a tenth of a micrometre."""
    return f"{where(np.round(1e3 * np.asarray(place), 4) + 0.0)} mm"


def crossings(vessel: Vessel) -> Finding:
    """Whether triangles cut through each other; at the rim of an opening that does no harm."""
    faces = np.asarray(vessel.faces, np.int64)
    mesh.log_stage("looking for triangles that cut others", len(faces))
    crossed = mesh.self_intersections(vessel.vertices, faces)
    rim = np.zeros(len(vessel.vertices), bool)
    rim[faces[vessel.face_opening >= 0]] = True
    inner = crossed[~rim[faces[crossed]].any(axis=1)]
    if len(inner):
        place = text_of(vessel.vertices[faces[inner[0]]].mean(axis=0))
        return Finding(
            False, f"{len(inner)} triangles of the wall cut through others, first at {place}"
        )
    if len(crossed):
        return Finding(
            True, f"self-intersections only at openings' rims ({len(crossed)} triangles)"
        )
    return Finding(True, "no self-intersections")


def check_vessel(vessel: Vessel) -> list[Finding]:
    """What `vesselflow info` says about a surface."""
    faces = np.asarray(vessel.faces, np.int64)
    low, high = vessel.bounds
    size = " x ".join(f"{1e3 * value:.1f}" for value in high - low)
    closed = mesh.is_closed(faces)
    handles = mesh.genus(faces)
    findings = [
        Finding(closed, "closed" if closed else "not closed"),
        Finding(True, f"{len(faces)} triangles, {size} mm, lumen {vessel.volume * 1e6:.4g} ml"),
        Finding(handles == 0, "no handles" if handles == 0 else f"{handles} handles (loops)"),
        crossings(vessel),
        Finding(True, f"narrowest place {1e3 * vessel.narrowest:.2f} mm"),
        *(Finding(True, note) for note in vessel.notes),
    ]
    widest = max((opening.radius for opening in vessel.openings), default=0.0)
    if widest > LARGEST_RADIUS or vessel.volume > LARGEST_VOLUME:
        findings.append(Finding(False, "no vessel is so large; is vessel.scale right?"))
    for opening in vessel.openings:
        state = "open" if opening.is_open else "capped"
        findings.append(
            Finding(True, f"opening {opening.name}: {state}, radius {1e3 * opening.radius:.2f} mm")
        )
    for opening in vessel.unnamed:
        findings.append(
            Finding(
                False,
                f"flat end at {text_of(opening.centre)}, radius "
                f"{1e3 * opening.radius:.2f} mm, not named by the scene: capped",
            )
        )
    return findings


def check_gaps(wall: WallSample, spacing: float, setback: float) -> list[Finding]:
    """What is said of parts of the lumen side by side, between which the wall is thin.

    Args:
        wall: The wall's proxies.
        spacing: Of the blood [m].
        setback: Of the proxies [m].
    """
    gap = wall.narrowest_gap
    if not np.isfinite(gap):
        return []
    place = f"two parts of the lumen come within {1e3 * gap:.3g} mm of each other at "
    place += text_of(np.array(wall.gap_place))
    if gap >= 2.0 * setback:
        return [Finding(False, f"{place}: blood beside the gap feels both walls")]
    narrower = setback - 0.5 * gap
    return [
        Finding(
            False,
            f"{place}, nearer than two setbacks of the wall ({2e3 * setback:.3g} mm): one wall "
            f"stands between them, half-way, and each part is up to {1e3 * narrower:.3g} mm "
            f"narrower there; a spacing below {1e3 * 0.5 * gap / setback * spacing:.2g} mm "
            "resolves the gap",
        )
    ]


def check_outlets(vessel: Vessel) -> list[Finding]:
    """What is said of openings that another branch passes by.

    Raises:
        InputError: the lumen lies right beyond an opening.
    """
    findings = []
    for k, opening in enumerate(vessel.openings):
        clear = vessel.clear_beyond(k, BEYOND) if opening.is_open else np.inf
        if clear < BEYOND * opening.radius:
            text = f"another branch passes {1e3 * clear:.3g} mm beside opening {opening.name}: "
            text += "blood farther from its middle has not left by it"
            findings.append(Finding(True, text))
    return findings


def check_gravity(
    vessel: Vessel, opening: str, acceleration: tuple[float, float, float]
) -> list[Finding]:
    """What is said of gravity [m/s^2] that pulls blood out of its column's opening."""
    end, gravity = vessel.opening(opening), np.array(acceleration)
    g = float(np.linalg.norm(gravity))
    if g == 0.0 or not end.is_open:
        return []
    angle = float(np.degrees(np.arccos(np.clip(-(gravity @ end.normal) / g, -1.0, 1.0))))
    if angle <= STEEPEST:
        return []
    return [
        Finding(
            False,
            f"gravity points {angle:.0f} degrees off the way into opening {opening}: blood of the "
            "column runs out of it",
        )
    ]
