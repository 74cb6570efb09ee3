"""A user's own surface, capped or open, made into a scene folder: `vesselflow new my.stl`."""

import json
import math
import os
import shutil
import tempfile
from pathlib import Path

import igl
import numpy as np

from taichi_sph.errors import InputError
from taichi_sph.geometry import mesh
from taichi_sph.geometry.mesh import Floats, Integers
from taichi_sph.geometry.openings import Candidate, find_openings, is_round
from taichi_sph.geometry.surface_file import load_surface, require_manifold, where
from taichi_sph.geometry.vessel import (
    LARGEST,
    SMALLEST,
    Vessel,
    build_vessel,
    crossings,
    read_vessel,
)
from taichi_sph.scene import Column, OpeningTable, parse_scene

ACROSS, LEAST = 8.0, 6.0
"""Particles across the narrowest place that a new scene aims at, and makes do with."""
FEWEST, MOST = 3000, 6000
"""Blood particles that a new scene aims at."""

DEEP = 2.5
"""Depth of a new scene's column, over its opening's radius."""


def create_scene(
    path: Path, out: Path | None = None, scale: float | None = None, spacing: float | None = None
) -> str:
    """Turn a surface file into a folder with lumen.ply, scene.toml and README.md.

    Args:
        path: Mesh of a lumen, closed with flat caps or open at its ends (STL, PLY, OBJ).
        out: Folder to make; it must not exist.  None: the file's name, in the working directory.
        scale: Metres per unit of the file; None guesses it from the size.
        spacing: Distance between blood particles [m]; None chooses it.

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
    scale = _guess_scale(vertices, scale, path, notes)
    vertices, faces = _tidy(vertices * scale, faces, str(path), notes)
    vertices, faces, found = _openings(vertices, faces, str(path), notes)
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    vertices = vertices - middle
    places = {f"opening_{k}": c.centre - middle for k, c in enumerate(found, 1)}
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
    _describe(vessel, notes)
    gravity = _gravity(vessel, notes)
    step, height = _column(vessel, spacing, notes)
    title = path.stem.encode("utf-8", "replace").decode()
    text = _scene_text(title, tables, gravity, step, height)
    readme = _readme(title, path.name.encode("utf-8", "replace").decode(), notes)
    _publish(folder, vertices, faces, text, readme)
    return "\n".join([f"{folder}: new scene", *(f"  {note}" for note in notes)])


def _guess_scale(vertices: Floats, scale: float | None, path: Path, notes: list[str]) -> float:
    """Metres per unit of the file."""
    extent = float(np.ptp(vertices, axis=0).max())
    if scale is None:
        guesses = {1.0: "metres", 1e-3: "millimetres", 1e-6: "micrometres"}
        for guess, unit in guesses.items():
            if SMALLEST <= extent * guess <= LARGEST:
                notes.append(
                    f"units: assumed {unit}, for the surface is {extent:.4g} units across "
                    f"({1e3 * extent * guess:.4g} mm); --scale sets another"
                )
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
    notes.append(f"units: {scale:g} m per unit, as given ({1e3 * extent * scale:.4g} mm across)")
    return scale


def _tidy(
    vertices: Floats, faces: Integers, label: str, notes: list[str]
) -> tuple[Floats, Integers]:
    """One piece, triangles turning alike."""
    vertices, faces = mesh.clean(vertices, faces)
    if len(faces) == 0:
        raise InputError(f"{label}: all triangles have collapsed to lines; a tube is needed")
    count, piece = mesh.components(faces, len(vertices))
    if count > 1:
        area = np.linalg.norm(mesh.face_vectors(vertices, faces), axis=1)
        share = np.bincount(piece, area) / area.sum()
        if share.max() < 0.99:
            raise InputError(
                f"{label}: {count} separate pieces, the largest with {100 * share.max():.0f} % of "
                "the area; the lumen must be one connected surface"
            )
        vertices, faces = mesh.drop_unused(vertices, faces[piece == share.argmax()])
        notes.append(f"left out: {count - 1} small loose pieces, {100 * (1 - share.max()):.2g} %")
    if not mesh.is_winding_consistent(faces) and (mesh.edge_uses(faces)[2] <= 2).all():
        faces = np.ascontiguousarray(igl.bfs_orient(faces)[0], np.int64)
        notes.append("normals: neighbouring triangles turned different ways; made to agree")
    require_manifold(vertices, faces, label)
    return vertices, faces


def _openings(
    vertices: Floats, faces: Integers, label: str, notes: list[str]
) -> tuple[Floats, Integers, list[Candidate]]:
    """The closed surface, outward, and its openings, the largest first."""
    vertices, faces, found = find_openings(vertices, faces, label)
    if mesh.enclosed_volume(vertices, faces) < 0:
        vertices, faces, found = find_openings(
            vertices, np.ascontiguousarray(faces[:, ::-1]), label
        )
        notes.append("normals: pointed inwards; turned round")
    open_ends = sum(c.from_hole for c in found)
    # A flat piece of wall is seldom as round as a cut through a vessel; an oblique cut is oval.
    found = [c for c in found if c.from_hole or is_round(vertices, faces[c.faces], 0.6)]
    largest = max((c.area for c in found), default=0.0)
    found = sorted(
        (c for c in found if c.from_hole or c.area > 0.01 * largest),
        key=lambda c: (-c.area, *c.centre.tolist()),
    )
    if not found:
        raise InputError(
            f"{label}: no opening found; allowed: a surface with holes at its ends, or with flat "
            "caps that meet the wall at an edge"
        )
    if open_ends:
        notes.append(f"capped: {open_ends} open ends, flat")
    return vertices, faces, found


def _describe(vessel: Vessel, notes: list[str]) -> None:
    notes.append(f"lumen: {vessel.volume * 1e6:.4g} ml, {len(vessel.faces)} triangles, closed")
    crossed = crossings(vessel)
    notes.append(crossed.text if crossed.good else f"warning: {crossed.text}; blood may leak there")
    for opening in vessel.openings:
        notes.append(
            f"{opening.name}: at {where(1e3 * opening.centre)} mm, radius "
            f"{1e3 * opening.radius:.3g} mm; assumed open"
        )


def _gravity(vessel: Vessel, notes: list[str]) -> Floats:
    """From the largest opening towards the others [m/s^2], (3,)."""
    top, *others = vessel.openings
    if others:
        along = mesh.unit(np.mean([o.centre for o in others], axis=0) - top.centre)
        notes.append("gravity: assumed along from opening_1 towards the others")
    else:
        along = -top.normal
        notes.append("gravity: assumed straight into opening_1, the only one")
    return 9.81 * along


def _round_down(value: float) -> float:
    """Two significant digits."""
    digits = 1 - math.floor(math.log10(value))
    return float(f"{math.floor(value * 10**digits + 1e-9) / 10**digits:.12g}")


def _column(vessel: Vessel, spacing: float | None, notes: list[str]) -> tuple[float, float]:
    """Spacing and height of the blood column [m]."""
    top = vessel.openings[0]
    if spacing is None:
        spacing = vessel.narrowest / ACROSS
        # A wide opening above a narrow way: coarser, or the column would be a mere film; a vessel
        # without narrow places: finer, or it would be a handful of particles.
        coarse = (0.9 * top.area * 2.0 * top.radius / MOST) ** (1 / 3)
        fine = (0.9 * top.area * DEEP * top.radius / FEWEST) ** (1 / 3)
        spacing = min(max(spacing, coarse), vessel.narrowest / LEAST, fine)
        spacing = _round_down(spacing)
        reason = "chosen"
    else:
        reason = "as given"
    vessel.require_resolution(spacing)
    across = vessel.narrowest / spacing
    notes.append(
        f"spacing: {1e3 * spacing:.3g} mm, {reason}: {across:.1f} particles across the narrowest "
        f"place ({1e3 * vessel.narrowest:.3g} mm)"
    )
    # As deep as a little over the opening is wide, within the bounds; at any rate one radius.
    radius_deep = 0.9 * top.area * top.radius / spacing**3
    wanted = round(max(min(DEEP * radius_deep, MOST), FEWEST, radius_deep))
    while True:
        try:
            blood = vessel.fill_column(Column(opening=top.name, particles=wanted), spacing)
            break
        except InputError:
            if wanted < 100:
                raise
            wanted //= 2
    depth = float(((top.centre - blood) @ top.normal).max()) + 0.5 * spacing
    layers = max(1, round(depth / spacing))
    height = float(f"{layers * spacing:.6g}")
    blood = vessel.fill_column(Column(opening=top.name, height=height), spacing)
    notes.append(
        f"column: {len(blood)} blood particles, {1e3 * height:.3g} mm deep, at {top.name}, the "
        "largest"
    )
    return spacing, height


def _numbers(values: Floats | tuple[float, ...], digits: int) -> str:
    return "[" + ", ".join(f"{value:.{digits}f}" for value in values) + "]"


def _scene_text(
    title: str, tables: dict[str, OpeningTable], gravity: Floats, spacing: float, height: float
) -> str:
    lines = [
        "# SI units.  Made by `vesselflow new`; README.md says what it assumed.",
        f"title = {json.dumps(title, ensure_ascii=False)}",
        "duration = 0.5          # [s]",
        "frame_interval = 0.005  # [s]",
        f"gravity = {_numbers(gravity, 4)}  # [m/s^2]",
        "",
        "[vessel]",
        'surface = "lumen.ply"',
        "scale = 1.0             # metres per unit of the file",
    ]
    for name, table in tables.items():
        lines += ["", f"[openings.{name}]", f"centre = {_numbers(table.centre, 7)}"]
        lines += ['state = "open"           # or "capped"']
    lines += ["", "[column]", 'opening = "opening_1"', f"height = {height:.6g}  # [m]"]
    lines += ["", "[blood]", "density = 1060.0        # [kg/m^3]"]
    lines += ['rheology = { model = "casson" }']
    lines += ["", "[discretization]", f"spacing = {spacing:.6g}  # [m]"]
    return "\n".join(lines) + "\n"


def _readme(title: str, source: str, notes: list[str]) -> str:
    lines = [f"# {title}", "", f"Made by `vesselflow new` from `{source}`.  The surface is that"]
    lines += ["file's, in metres; its source and licence are for you to note here.", ""]
    return "\n".join([*lines, "Found and assumed:", "", *(f"- {note}" for note in notes)]) + "\n"


def _publish(folder: Path, vertices: Floats, faces: Integers, text: str, readme: str) -> None:
    """Write the files beside their place, read them back, then move the folder there at once."""
    temporary = None
    try:
        parent = folder.absolute().parent
        temporary = Path(tempfile.mkdtemp(prefix=".vesselflow-", dir=parent))
        mesh.write_ply(temporary / "lumen.ply", vertices, faces, "lumen, metres")
        (temporary / "scene.toml").write_text(text, encoding="utf-8")
        (temporary / "README.md").write_text(readme, encoding="utf-8")
        read_vessel(parse_scene(text, str(folder / "scene.toml"), temporary, folder.name))
        temporary.chmod(0o755)
        os.rename(temporary, folder)
        temporary = None
    except OSError as error:
        raise InputError(
            f"{folder}: cannot make the scene folder: {error.strerror or error}"
        ) from None
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)
