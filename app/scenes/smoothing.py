"""Stepped surfaces, as they come straight from a segmentation's voxels: told, and smoothed."""

import math

import numpy as np
import trimesh
from trimesh.smoothing import filter_taubin

from taichi_sph.errors import InputError
from taichi_sph.geometry import mesh
from taichi_sph.geometry.mesh import Floats, Integers
from taichi_sph.geometry.openings import close_holes, find_openings

STEP = 25.0
"""At the foot and the nose of a step the surface turns by more [degrees]: by 35 at least in a
surface through the voxels' edges, by 90 round the voxels themselves."""
STEPPED = 0.3
"""Share of the area beside both a foot and a nose from which a surface is stepped: 0.37 and more
is found, and 0.1 at most on lumens with crotches, bends and caps, 0.25 on coarse walls."""
LEVEL, TREADS = 0.5, 0.15
"""Triangles of a tread turn by less [degrees], and such a share of the edges at least is theirs."""
ROUNDS = 40
"""Rounds of Taubin's filter: steps of two voxels are gone then."""
SHRINK, GROW = 0.5, 0.53
"""Factors of its two half rounds (Taubin 1995, doi:10.1145/218380.218473): volume is kept."""


def stepped_share(vertices: Floats, faces: Integers) -> float:
    """Share of a surface's area in triangles that touch both a foot and a nose of steps.

    Zero where few neighbours lie in one plane: that is noise, which has no treads.
    """
    vectors = mesh.face_vectors(vertices, faces)
    normals, areas = mesh.unit(vectors), np.linalg.norm(vectors, axis=1)
    pairs, edges = mesh.face_pairs(faces)
    first, second = pairs.T
    middles = vertices[faces].mean(axis=1)
    cosine = np.einsum("ij,ij->i", normals[first], normals[second])
    rises = np.einsum("ij,ij->i", middles[second] - middles[first], normals[first]) > 0.0
    sharp = cosine < math.cos(math.radians(STEP))
    foot, nose = np.zeros(len(vertices), bool), np.zeros(len(vertices), bool)
    foot[edges[sharp & rises]] = True
    nose[edges[sharp & ~rises]] = True
    if (cosine > math.cos(math.radians(LEVEL))).mean() < TREADS:
        return 0.0
    both = foot[faces].any(axis=1) & nose[faces].any(axis=1)
    return float(areas[both].sum() / max(areas.sum(), 1e-300))


def smoothed(
    vertices: Floats, faces: Integers, label: str, scale: float, smooth: bool, notes: list[str]
) -> tuple[Floats, Integers]:
    """The surface, smoothed if asked for; its flat ends are taken out first and stay open.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3), outward.
        label: What messages call the surface.
        scale: Metres per unit of the file, in which messages give places.
        smooth: Whether that is asked for.
        notes: What was done is added to them.

    Raises:
        InputError: the surface is stepped and that is not asked for, or it cannot be closed.
    """
    share = stepped_share(vertices, faces)
    if not smooth:
        if share > STEPPED:
            raise InputError(
                f"{label}: the surface is stepped, as straight from the voxels of a segmentation: "
                f"{100 * share:.0f} % of it lies at steps; give --smooth, or smooth "
                "it elsewhere (with Taubin's filter or a windowed sinc)"
            )
        return vertices, faces
    closed, closed_faces, holes = close_holes(vertices, faces, label, scale)
    before = abs(mesh.enclosed_volume(closed, closed_faces))
    ends = find_openings(closed, closed_faces, holes, label, scale, "tips")
    capped = np.zeros(len(ends.faces), bool)
    for candidate in ends.found:
        capped[candidate.faces] = True
    vertices, faces = mesh.drop_unused(ends.vertices, ends.faces[~capped])
    surface = trimesh.Trimesh(vertices, faces, process=False)
    filter_taubin(surface, lamb=SHRINK, nu=GROW, iterations=ROUNDS)
    moved = float(np.linalg.norm(surface.vertices - vertices, axis=1).max())
    vertices = np.array(surface.vertices, np.float64)
    closed, closed_faces, _ = close_holes(vertices, faces, label, scale)
    after = abs(mesh.enclosed_volume(closed, closed_faces))
    notes.append(
        f"smoothed: {ROUNDS} rounds of Taubin's filter, the wall moved by at most "
        f"{1e3 * moved:.2g} mm, the volume from {1e6 * before:.4g} to {1e6 * after:.4g} ml"
    )
    return vertices, faces
