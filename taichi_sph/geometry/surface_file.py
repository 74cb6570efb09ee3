"""Surface files: reading a mesh and refusing what is no lumen.

Mistakes in the file are errors that say what was found and what to change.
"""

from pathlib import Path

import igl
import numpy as np

from taichi_sph.errors import InputError
from taichi_sph.geometry import mesh
from taichi_sph.geometry.mending import gap_hint
from taichi_sph.geometry.mesh import Booleans, Floats, Integers
from taichi_sph.geometry.surface_formats import (
    FormatError,
    Polygons,
    read_obj,
    read_ply,
    read_stl,
)
from taichi_sph.geometry.vtk_formats import HINT, read_vtk, read_vtp

READERS = {
    ".stl": read_stl,
    ".ply": read_ply,
    ".obj": read_obj,
    ".vtp": read_vtp,
    ".vtk": read_vtk,
}
FORMATS = "STL, PLY, OBJ, VTP, VTK (PolyData)"


def load_surface(path: Path) -> tuple[Floats, Integers]:
    """Read a mesh file (STL, PLY, OBJ, VTP, VTK) in the file's own units.

    Returns:
        vertices (n, 3) as the file has them, triangles (m, 3); polygons are cut into triangles.

    Raises:
        InputError: the file cannot be read, is cut, holds no triangle or a number that is not
            finite.
    """
    kind = path.suffix.lower()
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot read the surface: {error.strerror or error}") from None
    if kind not in READERS:
        raise InputError(
            f"{path}: not a readable {kind or '(none)'} surface; allowed: {FORMATS}"
            + (f"; {HINT}" if kind.startswith((".vt", ".pvt")) else "")
        )
    # A triangle takes some 50 bytes in most formats.
    mesh.log_stage(f"reading {path.name}, {len(data) / 1e6:.0f} MB", len(data) // 50)
    try:
        polygons = READERS[kind](data)
        faces = triangulate(polygons)
    except FormatError as error:
        allowed = "" if "allowed:" in str(error) else f"; allowed: {FORMATS}"
        raise InputError(f"{path}: not a readable {kind} surface: {error}{allowed}") from None
    vertices = polygons.points
    if len(faces) == 0 or len(vertices) == 0:
        raise InputError(f"{path}: the surface has no triangles; a closed or open tube is needed")
    bad = ~np.isfinite(vertices).all(axis=1)
    if bad.any():
        raise InputError(
            f"{path}: {int(bad.sum())} of {len(vertices)} vertices are not finite numbers "
            f"(first: vertex {int(np.argmax(bad))}); all must be finite"
        )
    return vertices, faces


def triangulate(polygons: Polygons) -> Integers:
    """Triangles (m, 3) of polygons, in their order; those of fewer than 3 corners are left out.

    A polygon that bulges everywhere is cut from its first corner, any other by cutting ears.

    Raises:
        FormatError: a polygon refers to a vertex that is not there, or crosses itself.
    """
    points, corners, sizes = polygons.points, polygons.corners, polygons.sizes
    if len(corners) and (corners.min() < 0 or corners.max() >= len(points)):
        wrong = corners.min() if corners.min() < 0 else corners.max()
        raise FormatError(f"a polygon refers to vertex {wrong}, but the file has {len(points)}")
    if (sizes == 3).all():
        return corners.reshape(-1, 3)
    starts = np.cumsum(sizes) - sizes
    rows, triangles = [np.zeros(0, np.int64)], [np.zeros((0, 3), np.int64)]
    for size in np.unique(sizes[sizes >= 3]).tolist():
        members = np.flatnonzero(sizes == size)
        table = corners[starts[members, None] + np.arange(size)]
        fan = np.stack([np.zeros(size - 2, int), *(np.arange(size - 2) + k for k in (1, 2))], 1)
        cut = table[:, fan]
        for k in np.flatnonzero(~_bulging(points, table)):
            cut[k] = _cut_polygon(points, table[k], int(members[k]))
        triangles.append(cut.reshape(-1, 3))
        rows.append(np.repeat(members, size - 2))
    order = np.argsort(np.concatenate(rows), kind="stable")
    return np.concatenate(triangles)[order]


def _bulging(points: Floats, table: Integers) -> Booleans:
    """Which polygons of as many corners (k, size) turn one way at each of them; triangles do."""
    with np.errstate(invalid="ignore"):  # not finite: said later, by the vertex
        place = points[table]
        along = np.roll(place, -1, axis=1) - place
        turn = np.cross(np.roll(along, 1, axis=1), along)
        normal = np.cross(place - place[:, :1], np.roll(place, -1, axis=1) - place[:, :1]).sum(
            axis=1
        )
        return np.asarray((np.einsum("ksc,kc->ks", turn, normal) >= 0).all(axis=1))


def _cut_polygon(points: Floats, polygon: Integers, number: int) -> Integers:
    """Triangles of one polygon, by cutting ears in the plane of its area."""
    place = points[polygon]
    centre, normal, area = mesh.loop_plane(place)
    if not area > 0.0:
        # Flat to a line, or not finite: any cut will do, for what follows looks at it.
        return np.stack([np.full(len(polygon) - 2, polygon[0]), polygon[1:-1], polygon[2:]], axis=1)
    first, second = mesh.plane_axes(normal)
    try:
        cut = mesh.cut_ears(np.stack([(place - centre) @ first, (place - centre) @ second], axis=1))
    except ValueError:
        raise FormatError(
            f"polygon {number + 1}, of {len(polygon)} corners, crosses itself"
        ) from None
    return polygon[cut]


def where(point: Floats) -> str:
    """A point as text."""
    return "(" + ", ".join(f"{value:.4g}" for value in point) + ")"


def require_manifold(vertices: Floats, faces: Integers, label: str, scale: float = 1.0) -> None:
    """Refuse a surface that is not one piece of skin.

    Args:
        vertices: (n, 3).
        faces: (m, 3).
        label: What messages call the surface.
        scale: Of the vertices, over the units of the file, in which places are said.

    Raises:
        InputError: an edge with more than two triangles, surfaces that touch at a point,
            triangles that turn different ways, several pieces.
    """
    mesh.log_stage(f"checking edges and corners of {len(faces)} triangles", len(faces))
    edges, _, uses = mesh.edge_uses(faces)
    if (uses > 2).any():
        first = edges[np.argmax(uses > 2)]
        raise InputError(
            f"{label}: {int((uses > 2).sum())} edges have more than two triangles (first at "
            f"{where(vertices[first].mean(axis=0) / scale)}, in units of the file): a wall within "
            "the lumen, or parts laid over each other; allowed: one or two triangles at every edge"
        )
    count, piece = mesh.components(faces)
    if count > 1:
        sizes = ", ".join(str(n) for n in np.sort(np.bincount(piece))[::-1][:5])
        raise InputError(
            f"{label}: {count} separate pieces (triangles: {sizes}{', ...' if count > 5 else ''}); "
            f"the lumen must be one connected surface{gap_hint(vertices, faces, scale)}"
        )
    pinched = ~np.asarray(igl.is_vertex_manifold(faces)).reshape(-1)
    if pinched.any():
        place = where(vertices[int(np.argmax(pinched))] / scale)
        raise InputError(
            f"{label}: parts of the surface touch at a single vertex (first at {place}, in units "
            f"of the file); separate or merge them{gap_hint(vertices, faces, scale)}"
        )
    if not mesh.is_winding_consistent(faces):
        raise InputError(
            f"{label}: neighbouring triangles turn different ways, so inside and outside are not "
            "defined; make the normals consistent and outward"
        )


def require_outward(vertices: Floats, faces: Integers, label: str) -> None:
    """Refuse a closed surface whose normals point inwards.

    Raises:
        InputError: they do, or the surface encloses nothing.
    """
    volume = mesh.enclosed_volume(vertices, faces)
    extent = float(np.ptp(vertices, axis=0).max())
    if abs(volume) < 1e-9 * extent**3:
        raise InputError(f"{label}: the surface is flat and encloses no volume; a tube is needed")
    if volume < 0:
        raise InputError(
            f"{label}: the normals point inwards (enclosed volume {volume:.3g} m^3); "
            "turn the triangles round so that they point out of the lumen"
        )
