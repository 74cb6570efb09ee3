"""Gaps between parts of a lumen that lie side by side: legs of a bifurcation, loops of a siphon.

Two places on the wall face each other across a gap if it is outside the lumen and the way from one
to the other along the surface is long; in the crotch of a bifurcation it is short.
"""

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from taichi_sph.geometry import mesh
from taichi_sph.geometry.closed_surface import ClosedSurface
from taichi_sph.geometry.mesh import Booleans, Floats, Integers

WAY_ROUND = 10.0
"""What is nearer along the surface is the same crotch [spacings]: walls that part at 20 degrees are
1.5 spacings from each other after a way of 9."""
_ASIDE = 1.2
"""Points straight across from each other are no farther aside [spacings]."""
_THROUGH = 0.5
"""Walls that touch may cut a little through each other [spacings]; no lumen is as narrow."""
_CHUNK = 64


def gaps_at(
    surface: ClosedSurface, faces: Integers, points: Floats, on: Integers, normals: Floats,
    spacing: float, most: float,
) -> Floats:  # fmt: skip
    """Width of the gap outside the wall at points on it [m], (k,); infinite where there is none.

    Args:
        surface: The lumen's [m].
        faces: Triangles of its vertices that are wall (m, 3).
        points: On them, evenly (k, 3) [m].
        on: The triangle of the wall that each is on (k,).
        normals: Unit normals out of the lumen (k, 3).
        spacing: Of the points [m].
        most: Wider gaps are none [m].
    """
    gaps = np.full(len(points), np.inf)
    i, j = cKDTree(points).query_pairs(np.hypot(most, _ASIDE * spacing), output_type="ndarray").T
    apart = points[j] - points[i]
    ahead = np.einsum("ij,ij->i", apart, normals[i])
    back = -np.einsum("ij,ij->i", apart, normals[j])
    facing = np.einsum("ij,ij->i", normals[i], normals[j]) < -0.5
    square = np.einsum("ij,ij->i", apart, apart)
    across = facing & (np.minimum(ahead, back) > -_THROUGH * spacing)
    across &= square - np.maximum(ahead, back) ** 2 < (_ASIDE * spacing) ** 2
    i, j, width = i[across], j[across], np.maximum(np.minimum(ahead, back)[across], 0.0)
    near = width < most
    i, j, width = i[near], j[near], width[near]
    far = _far_round(surface.vertices, faces, on[i], on[j], WAY_ROUND * spacing)
    for end in (i, j):
        np.minimum.at(gaps, end[far], width[far])
    rows = np.flatnonzero(np.isfinite(gaps))
    gaps[rows] = _across(surface, points[rows], normals[rows], gaps[rows], spacing)
    gaps[gaps >= most] = np.inf
    return gaps


def _across(
    surface: ClosedSurface, points: Floats, normals: Floats, about: Floats, spacing: float
) -> Floats:
    """Distance from points to the other side of a gap [m], (k,), from what it is `about` [m].

    Points are never quite opposite; from beyond half-way the other side itself is the nearest.
    """
    facing = mesh.unit(mesh.face_vectors(surface.vertices, surface.faces))
    result = np.full(len(points), np.inf)
    for more in (0.3, 0.6, 1.0, 1.5):
        left = np.flatnonzero(np.isinf(result))
        ahead = 0.6 * about[left] + more * spacing
        beyond = points[left] + ahead[:, None] * normals[left]
        _, triangle, place = surface.nearest(beyond)
        other = np.einsum("ij,ij->i", facing[triangle], normals[left]) < -0.3
        result[left[other]] = np.linalg.norm(place[other] - points[left[other]], axis=1)
    return result


def _far_round(
    vertices: Floats, faces: Integers, first: Integers, second: Integers, least: float
) -> Booleans:
    """Which pairs of triangles are at least so far from each other along the surface [m], (p,)."""
    if len(first) == 0:
        return np.zeros(0, bool)
    edges = mesh.edge_uses(faces)[0]
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    ways = (edges.T.reshape(-1), edges.T[::-1].reshape(-1))
    graph = csr_matrix((np.tile(length, 2), ways), shape=(len(vertices),) * 2)
    touch = (faces[first][:, :, None] == faces[second][:, None, :]).any(axis=(1, 2))
    result = np.zeros(len(first), bool)
    sources, which = np.unique(faces[first, 0], return_inverse=True)
    which = which.reshape(-1)
    for begin in range(0, len(sources), _CHUNK):
        rows = np.flatnonzero((which >= begin) & (which < begin + _CHUNK) & ~touch)
        if len(rows):
            away = dijkstra(graph, indices=sources[begin : begin + _CHUNK], limit=least)
            there = away[which[rows, None] - begin, faces[second[rows]]]
            result[rows] = np.isinf(there).all(axis=1)
    return result
