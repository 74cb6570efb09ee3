"""Openings of a lumen surface: reading a mesh file, finding flat ends, capping open ones.

Mistakes in the file are errors that say what was found and what to change.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np
import trimesh

from taichi_sph.errors import InputError
from taichi_sph.geometry import mesh
from taichi_sph.geometry.mesh import Floats, Integers


@dataclass(frozen=True, eq=False)
class Opening:
    """A flat end of the lumen."""

    name: str
    """The scene's name for it."""
    centre: Floats
    """Middle of the cap [m], (3,)."""
    normal: Floats
    """Unit normal out of the lumen, (3,)."""
    radius: float
    """Radius of the circle of equal area [m]."""
    area: float
    """Area of the cap [m^2]."""
    is_open: bool
    """Blood leaves through an open one; a capped one is wall."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A flat end found on a surface, not yet named."""

    centre: Floats
    normal: Floats
    area: float
    faces: Integers
    from_hole: bool

    @property
    def radius(self) -> float:
        """Radius of the circle of equal area."""
        return math.sqrt(self.area / math.pi)


def load_surface(path: Path) -> tuple[Floats, Integers]:
    """Read a mesh file (STL, PLY, OBJ and what else trimesh reads) in the file's own units.

    Raises:
        InputError: the file cannot be read, holds no triangle or a number that is not finite.
    """
    try:
        with path.open("rb") as file:
            loaded = trimesh.load(
                file, file_type=path.suffix.lstrip(".").lower(), process=False, force="mesh"
            )
        vertices = np.array(loaded.vertices, np.float64).reshape(-1, 3)
        faces = np.array(loaded.faces, np.int64).reshape(-1, 3)
    except OSError as error:
        raise InputError(f"{path}: cannot read the surface: {error.strerror or error}") from None
    except Exception as error:
        # Mesh readers fail in every way on bytes that are not what the name promises.
        reason = str(error).splitlines()[0][:100] if str(error) else type(error).__name__
        kind = path.suffix or "(none)"
        raise InputError(
            f"{path}: not a readable {kind} surface ({reason}); allowed: STL, PLY, OBJ"
        ) from None
    if len(faces) == 0 or len(vertices) == 0:
        raise InputError(f"{path}: the surface has no triangles; a closed or open tube is needed")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(
            f"{path}: a triangle refers to vertex {faces.max()}, but the file has {len(vertices)}"
        )
    bad = ~np.isfinite(vertices).all(axis=1)
    if bad.any():
        raise InputError(
            f"{path}: {int(bad.sum())} of {len(vertices)} vertices are not finite numbers "
            f"(first: vertex {int(np.argmax(bad))}); all must be finite"
        )
    return vertices, faces


def where(point: Floats) -> str:
    """A point as text."""
    return "(" + ", ".join(f"{value:.4g}" for value in point) + ")"


def require_manifold(vertices: Floats, faces: Integers, label: str) -> None:
    """Refuse a surface that is not one piece of skin.

    Raises:
        InputError: an edge with more than two triangles, surfaces that touch at a point,
            triangles that turn different ways, several pieces.
    """
    edges, _, uses = mesh.edge_uses(faces)
    if (uses > 2).any():
        first = edges[np.argmax(uses > 2)]
        raise InputError(
            f"{label}: {int((uses > 2).sum())} edges have more than two triangles (first at "
            f"{where(vertices[first].mean(axis=0))}); a surface needs one or two at every edge"
        )
    count, piece = mesh.components(faces, len(vertices))
    if count > 1:
        sizes = ", ".join(str(n) for n in np.sort(np.bincount(piece))[::-1][:5])
        raise InputError(
            f"{label}: {count} separate pieces (triangles: {sizes}{', ...' if count > 5 else ''}); "
            "the lumen must be one connected surface"
        )
    pinched = ~np.asarray(igl.is_vertex_manifold(faces)).reshape(-1)
    if pinched.any():
        place = where(vertices[int(np.argmax(pinched))])
        raise InputError(
            f"{label}: parts of the surface touch at a single vertex (first at {place}); "
            "separate or merge them"
        )
    if not mesh.is_winding_consistent(faces):
        raise InputError(
            f"{label}: neighbouring triangles turn different ways, so inside and outside are not "
            "defined; make the normals consistent and outward"
        )


def close_holes(
    vertices: Floats, faces: Integers, label: str
) -> tuple[Floats, Integers, list[Candidate]]:
    """Cap the open ends of a tube flat.

    Raises:
        InputError: a hole is not the end of a tube.
    """
    try:
        loops = mesh.boundary_loops(faces)
    except ValueError as error:
        raise InputError(f"{label}: {error}; close the holes or cut the ends flat") from None
    if not loops:
        return vertices, faces, []
    areas = mesh.face_vectors(vertices, faces)
    wall_normal = mesh.unit(areas)
    edge_of = {tuple(edge): k // 3 for k, edge in enumerate(mesh.directed_edges(faces).tolist())}
    extent = float(np.ptp(vertices, axis=0).max())
    found = []
    for loop in loops:
        rim = vertices[loop[::-1]]
        centre, normal, area = mesh.loop_plane(rim)
        around = float(np.linalg.norm(np.roll(rim, -1, axis=0) - rim, axis=1).sum())
        radius = math.sqrt(area / math.pi)
        height = (rim - centre) @ normal
        beside = [edge_of[(int(a), int(b))] for a, b in zip(loop, np.roll(loop, -1), strict=True)]
        steep = float(np.abs(wall_normal[beside] @ normal).mean())
        if len(loop) < 6 or radius < 1e-3 * extent:
            reason = f"it has {len(loop)} edges"
        elif 4 * math.pi * area < 0.4 * around**2:
            reason = "its rim is not round"
        elif np.ptp(height) > 0.5 * radius:
            reason = "its rim is not flat"
        elif steep > 0.75:
            reason = "the wall lies in its plane"
        else:
            reason = ""
        if reason:
            raise InputError(
                f"{label}: a hole of radius {radius:.3g} m at {where(centre)} m is not the end of "
                f"a tube ({reason}); close it, or cut the end flat"
            )
        ring = loop[::-1]
        if np.ptp(height) > 1e-3 * radius:
            # An uneven rim is carried on along the normal to a flat one; the strip is wall.
            level = float(height.max()) + 0.25 * around / len(loop)
            lifted = rim + (level - height)[:, None] * normal
            upper = len(vertices) + np.arange(len(ring))
            vertices = np.concatenate([vertices, lifted])
            after, above = np.roll(ring, -1), np.roll(upper, -1)
            strip = np.concatenate(
                [np.stack([ring, after, above], 1), np.stack([ring, above, upper], 1)]
            )
            faces = np.concatenate([faces, strip])
            ring, rim = upper, lifted
        else:
            vertices = vertices.copy()
            vertices[ring] -= height[:, None] * normal
            rim = vertices[ring]
        try:
            extra, cap = mesh.fill_polygon(rim)
        except ValueError as error:
            raise InputError(f"{label}: the hole at {where(centre)} m: {error}") from None
        number = np.concatenate([ring, len(vertices) + np.arange(len(extra))])
        vertices = np.concatenate([vertices, extra])
        members = len(faces) + np.arange(len(cap))
        faces = np.concatenate([faces, number[cap]])
        centre, normal, area = mesh.loop_plane(rim)
        found.append(Candidate(centre, normal, area, members, from_hole=True))
    return vertices, faces, found


def find_openings(
    vertices: Floats, faces: Integers, label: str
) -> tuple[Floats, Integers, list[Candidate]]:
    """Close a surface and find its flat ends, those from holes first, each group by area.

    Raises:
        InputError: a hole is not the end of a tube.
    """
    original = faces
    caps = [
        Candidate(*mesh.region_plane(vertices, original[region]), region, from_hole=False)
        for region in mesh.flat_regions(vertices, original)
    ]
    vertices, faces, holes = close_holes(vertices, faces, label)
    holes.sort(key=lambda found: -found.area)
    return vertices, faces, holes + caps


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


def is_round(vertices: Floats, faces: Integers, roundness: float) -> bool:
    """Whether 4 pi area / rim^2 of a flat region reaches a value: a disc 1, a square 0.785."""
    edges, _, uses = mesh.edge_uses(faces)
    rim = vertices[edges[uses == 1]]
    around = float(np.linalg.norm(rim[:, 0] - rim[:, 1], axis=1).sum())
    area = float(np.linalg.norm(mesh.face_vectors(vertices, faces), axis=1).sum())
    return 4 * math.pi * area > roundness * around**2
