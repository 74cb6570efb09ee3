"""A user's own surface, capped or open, made into a scene folder: `vesselflow new my.stl`."""

import math
from dataclasses import replace
from pathlib import Path

import igl
import msgspec
import numpy as np

from app.scenes.assumptions import choose_column, choose_gravity
from app.scenes.scene_folder import publish, readme_text, scene_text
from app.scenes.smoothing import smoothed
from taichi_sph.errors import InputError
from taichi_sph.geometry import mesh
from taichi_sph.geometry.caps import BULGE, refuse_shells
from taichi_sph.geometry.findings import LARGEST_RADIUS, LARGEST_VOLUME, crossings, text_of
from taichi_sph.geometry.mending import largest_piece, mend
from taichi_sph.geometry.mesh import Floats, Integers
from taichi_sph.geometry.openings import Ends, close_holes, find_openings
from taichi_sph.geometry.surface_file import load_surface, require_manifold, where
from taichi_sph.geometry.vessel import (
    LARGEST,
    SMALLEST,
    Vessel,
    build_vessel,
)
from taichi_sph.scene import OpeningTable

METRES, MILLIMETRES, MICROMETRES = 1.0, 1e-3, 1e-6
"""Units that are guessed, in metres."""


def create_scene(
    path: Path,
    out: Path | None = None,
    scale: float | None = None,
    spacing: float | None = None,
    smooth: bool = False,
) -> str:
    """Turn a surface file into a folder with lumen.ply, scene.toml and README.md.

    Args:
        path: Mesh of a lumen, closed with flat caps or open at its ends (STL, PLY, OBJ,
            VTP, VTK).
        out: Folder to make; it must not exist.  None: the file's name, in the working directory.
        scale: Metres per unit of the file; None guesses it from the size.
        spacing: Distance between blood particles [m]; None chooses it.
        smooth: Whether to smooth the surface, as one straight from voxels needs.

    Returns:
        What was found and assumed, line by line.

    Raises:
        InputError: the surface cannot be used, or the folder cannot be made.
    """
    folder = Path(path.stem) if out is None else out
    if folder.exists() or folder.is_symlink():
        raise InputError(f"{folder}: already exists; --out must name a folder that does not")
    for name, value in (("--scale", scale), ("--spacing", spacing)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise InputError(f"{name}: {value:g} is not a length; allowed: positive numbers")
    vertices, faces = load_surface(path)
    notes: list[str] = []
    # In units of the file: a speck far away shall not decide what they are.
    vertices, faces = _tidy(vertices, faces, str(path), notes)
    given, scale = scale, _guess_scale(vertices, scale, path)
    vertices, faces = smoothed(vertices * scale, faces, str(path), scale, smooth, notes)
    ends = _openings(vertices, faces, str(path), scale, notes)
    notes.insert(0, _describe_units(ends, scale, given, path))
    vertices, faces = ends.vertices, ends.faces
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    vertices = vertices - middle
    places = {f"opening_{k}": c.centre - middle for k, c in enumerate(ends.found, 1)}
    notes.append(
        f"moved: the middle of the bounding box, {where(middle / scale)} in the file, is now 0"
    )
    tables = {
        name: OpeningTable(centre=(float(c[0]), float(c[1]), float(c[2])))
        for name, c in places.items()
    }
    # Single precision is what the file will hold.
    vertices = vertices.astype(np.float32).astype(np.float64)
    vessel = build_vessel(vertices, faces, tables, 1.0, str(path))
    _describe(vessel, ends, middle, notes)
    gravity = choose_gravity(vessel, notes)
    vessel, step, height = choose_column(vessel, spacing, notes)
    tables = {
        o.name: msgspec.structs.replace(tables[o.name], state="open" if o.is_open else "capped")
        for o in vessel.openings
    }
    title = path.stem.encode("utf-8", "replace").decode()
    text = scene_text(title, tables, gravity, step, height)
    readme = readme_text(title, path.name.encode("utf-8", "replace").decode(), notes)
    publish(folder, vertices, faces, text, readme)
    return "\n".join([f"{folder}: new scene", *(f"  {note}" for note in notes)])


def _guess_scale(vertices: Floats, scale: float | None, path: Path) -> float:
    """Metres per unit of the file.

    Raises:
        InputError: no unit makes a vessel of it.
    """
    extent = float(np.ptp(vertices, axis=0).max())
    if scale is None:
        for guess in (METRES, MILLIMETRES, MICROMETRES):
            if SMALLEST <= extent * guess <= LARGEST:
                return guess
        raise InputError(
            f"{path}: {extent:.4g} units across, which is no vessel in metres, millimetres or "
            "micrometres; give --scale in metres per unit"
        )
    if not SMALLEST <= extent * scale <= LARGEST:
        raise InputError(
            f"--scale: {scale:g} makes {path} {extent * scale:.4g} m across; allowed: "
            f"{SMALLEST:g} to {LARGEST:g} m"
        )
    return scale


def _describe_units(ends: Ends, scale: float, given: float | None, path: Path) -> str:
    """What is said of the units, once the openings are known.

    Raises:
        InputError: the units were guessed, and no vessel is so large.
    """
    extent = float(np.ptp(ends.vertices, axis=0).max()) / scale
    radius = max(c.radius for c in ends.found) / scale
    volume = mesh.enclosed_volume(ends.vertices, ends.faces) / scale**3

    def sizes(unit: float) -> str:
        return (
            f"{1e3 * extent * unit:.3g} mm across, opening of radius {1e3 * radius * unit:.3g} mm, "
            f"{1e6 * volume * unit**3:.3g} ml"
        )

    def is_vessel(unit: float) -> bool:
        small = radius * unit <= LARGEST_RADIUS and volume * unit**3 <= LARGEST_VOLUME
        return small and SMALLEST <= extent * unit <= LARGEST

    if given is not None:
        return f"units: {scale:g} m per unit, as given ({1e3 * extent * scale:.4g} mm across)"
    unit = {METRES: "metres", MILLIMETRES: "millimetres", MICROMETRES: "micrometres"}[scale]
    if not is_vessel(scale):
        others = {1.0: "metres", 0.01: "centimetres", 0.0254: "inches", 1e-3: "millimetres"}
        choices = "; ".join(
            f"{value:g} for {name} ({sizes(value)})"
            for value, name in others.items()
            if value != scale
        )
        raise InputError(
            f"{path}: {extent:.4g} units across, which in {unit} is no vessel ({sizes(scale)}); "
            f"give --scale, in metres per unit: {choices}; or {scale:g} if it is so large"
        )
    note = (
        f"units: assumed {unit}, for the surface is {extent:.4g} units across "
        f"({1e3 * extent * scale:.4g} mm); --scale sets another"
    )
    if scale == MILLIMETRES and is_vessel(0.01):
        note += f", --scale 0.01 if these are centimetres ({sizes(0.01)})"
    return note


def _tidy(
    vertices: Floats, faces: Integers, label: str, notes: list[str]
) -> tuple[Floats, Integers]:
    """One piece, triangles turning alike."""
    vertices, faces, mended = mend(vertices, faces, label)
    refuse_shells(vertices, faces, label)
    vertices, faces, left = largest_piece(vertices, faces, label)
    notes += mended + left
    if not mesh.is_winding_consistent(faces) and (mesh.edge_uses(faces)[2] <= 2).all():
        faces = np.ascontiguousarray(igl.bfs_orient(faces)[0], np.int64)
        notes.append("normals: neighbouring triangles turned different ways; made to agree")
    require_manifold(vertices, faces, label)
    return vertices, faces


def _openings(
    vertices: Floats, faces: Integers, label: str, scale: float, notes: list[str]
) -> Ends:
    """The closed surface, outward, and its openings, the largest first.

    Raises:
        InputError: there are fewer than two, or an end bulges.
    """
    closed, closed_faces, holes = close_holes(vertices, faces, label, scale)
    if mesh.enclosed_volume(closed, closed_faces) < 0:
        faces = np.ascontiguousarray(faces[:, ::-1])
        closed, closed_faces, holes = close_holes(vertices, faces, label, scale)
        notes.append("normals: pointed inwards; turned round")
    ends = find_openings(closed, closed_faces, holes, label, scale, "both")
    for cap in ends.doubtful:
        if cap.bulge > BULGE:
            raise InputError(
                f"{label}: the end at {where(cap.centre / scale)} in units of the file is no cut "
                f"through a vessel: {cap.what_is_wrong} are allowed; cut it flat or leave it open"
            )
    if len(ends.found) < 2:
        raise InputError(f"{label}: {_too_few(ends, scale)}")
    found = sorted(ends.found, key=lambda c: (-c.area, *c.centre.tolist()))
    open_ends = sum(c.from_hole for c in found)
    if open_ends:
        notes.append(f"capped: {open_ends} open ends, flat")
    uneven = [c.bulge for c in found if c.bulge > 0.0]
    if uneven:
        notes.append(
            f"made flat: {len(uneven)} caps, which stood off their rims' planes by "
            f"{100 * max(uneven):.2g} % of the radius at most"
        )
    return replace(ends, found=found)


def _too_few(ends: Ends, scale: float) -> str:
    """What is said of a surface with one opening or none."""
    blind = "; ".join(where(tip.place / scale) for tip in ends.blind[:8])
    others = "; ".join(
        f"{where(cap.centre / scale)} ({cap.what_is_wrong})" for cap in ends.doubtful[:8]
    )
    text = "no opening found"
    if ends.found:
        text = f"only one opening found, at {where(ends.found[0].centre / scale)}"
    if blind:
        text += f"; closed and rounded off: {blind}"
    if others:
        text += f"; not taken: {others}"
    return (
        f"{text}; places are in units of the file; allowed: two or more ends that are open, or "
        "have flat caps that meet the wall at an edge"
    )


def _describe(vessel: Vessel, ends: Ends, middle: Floats, notes: list[str]) -> None:
    notes.append(f"lumen: {vessel.volume * 1e6:.4g} ml, {len(vessel.faces)} triangles, closed")
    crossed = crossings(vessel)
    notes.append(crossed.text if crossed.good else f"warning: {crossed.text}; blood may leak there")
    for opening in vessel.openings:
        notes.append(
            f"{opening.name}: at {text_of(opening.centre)}, radius "
            f"{1e3 * opening.radius:.3g} mm; assumed open"
        )
    for cap in ends.doubtful:
        notes.append(
            f"flat end not taken: at {text_of(cap.centre - middle)}, radius "
            f"{1e3 * cap.radius:.3g} mm: {cap.what_is_wrong}; it is wall"
        )
    for tip in ends.blind:
        notes.append(
            f"blind end: at {text_of(tip.place - middle)}, radius "
            f"{1e3 * tip.radius:.3g} mm, closed and rounded off: it is wall"
        )
