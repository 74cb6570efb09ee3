"""Surface files: reading a mesh and refusing what is no lumen.

Mistakes in the file are errors that say what was found and what to change.
"""

from pathlib import Path

import igl
import numpy as np
import trimesh

from taichi_sph.errors import InputError
from taichi_sph.geometry import mesh
from taichi_sph.geometry.mesh import Floats, Integers


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
