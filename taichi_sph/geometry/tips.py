"""Tips: where the branches of a closed surface end, whatever closes them.

A tip is a local maximum of the distance along the surface from another tip, if it stands out by
more than the vessel is wide.  The surface beyond a section has a vector area equal to the section's
(divergence theorem), which gives the branch's radius there.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra

from taichi_sph.geometry import mesh
from taichi_sph.geometry.mesh import Floats, Integers

STANDS_OUT = 0.5
"""A tip is so much farther away than where its branch meets another [radii of a tube of the
surface's volume and area]."""


@dataclass(frozen=True, eq=False)
class Tip:
    """The end of a branch."""

    place: Floats
    """The farthest point, (3,)."""
    axis: Floats
    """Unit vector out of the branch, (3,)."""
    radius: float
    """Of the circle of the area of the section that the end was cut off at."""
    faces: Integers
    """The triangles beyond that section."""


def find_tips(vertices: Floats, faces: Integers) -> list[Tip]:
    """Ends of the branches of a closed surface, the farthest apart first.

    A surface with handles has none: where two ways round meet is no end.
    """
    if mesh.genus(faces) > 0:
        return []
    vertices, faces = mesh.drop_unused(vertices, faces)
    area = float(np.linalg.norm(mesh.face_vectors(vertices, faces), axis=1).sum())
    radius = 2.0 * abs(mesh.enclosed_volume(vertices, faces)) / area
    edges = mesh.edge_uses(faces)[0]
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    n = len(vertices)
    graph = csr_matrix(
        (np.tile(length, 2), (edges.T.reshape(-1), edges.T[::-1].reshape(-1))), shape=(n, n)
    )
    start = int(dijkstra(graph, indices=0).argmax())
    away = np.asarray(dijkstra(graph, indices=start))
    tips = _maxima(graph, away, STANDS_OUT * radius)
    ends = [_tip(vertices, faces, away, tip, out) for tip, out in tips]
    # The start is a tip as well; as seen from the farthest it is a maximum.
    back = np.asarray(dijkstra(graph, indices=tips[0][0]))
    tips = _maxima(graph, back, STANDS_OUT * radius)
    near = min(tips, key=lambda found: float(np.linalg.norm(vertices[found[0]] - vertices[start])))
    return [*ends, _tip(vertices, faces, back, *near)]


def _maxima(graph: csr_matrix, height: Floats, least: float) -> list[tuple[int, float]]:
    """Vertices at maxima that stand out by `least`, and by how much, the highest first.

    From the highest vertex down, the parts of what lies above the water line are joined; where two
    meet, the lower one's top stands out by its height over that place.
    """
    part = np.full(len(height), -1)
    top: dict[int, int] = {}
    found: list[tuple[int, float]] = []
    cut: dict[int, float] = {}

    def root(k: int) -> int:
        while part[k] != k:
            part[k] = part[part[k]]
            k = int(part[k])
        return k

    for here in np.argsort(-height, kind="stable").tolist():
        part[here] = here
        top[here] = here
        for other in graph.indices[graph.indptr[here] : graph.indptr[here + 1]].tolist():
            if part[other] < 0:
                continue
            a, b = root(here), root(other)
            if a == b:
                continue
            low, high = sorted((a, b), key=lambda k: (height[top[k]], -top[k]))
            out = float(height[top[low]] - height[here])
            if out >= least:
                found.append((top[low], out))
                # The higher one is cut off from this one here too.
                cut.setdefault(top[high], float(height[top[high]] - height[here]))
            part[low] = high
    highest = int(height.argmax())
    found = [(highest, float(np.ptp(height))), *sorted(found, key=lambda f: -height[f[0]])]
    return [(tip, min(out, cut.get(tip, out))) for tip, out in found]


def _tip(vertices: Floats, faces: Integers, away: Floats, tip: int, out: float) -> Tip:
    """The end of a branch from its farthest vertex, cut off three radii down the branch.

    At any rate before it meets another, `out` below its tip.
    """
    depth = away[tip] - away[faces].max(axis=1)
    pairs, _ = mesh.face_pairs(faces)
    vectors = mesh.face_vectors(vertices, faces)
    reach = 1e-9 * float(np.ptp(vertices, axis=0).max())
    members = np.flatnonzero((faces == tip).any(axis=1))
    for _ in range(12):
        reach = min(reach, 0.95 * out)
        members = _part(depth < max(reach, 1e-300), pairs, int(members[0]), members)
        radius = math.sqrt(float(np.linalg.norm(vectors[members].sum(axis=0))) / math.pi)
        if reach >= min(3.0 * radius, 0.95 * out):
            break
        reach = 3.5 * radius if reach < radius else 1.3 * reach
    return Tip(vertices[tip], _axis(vectors[members]), radius, members)


def _axis(vectors: Floats) -> Floats:
    """Unit vector out of the end of a tube, from its triangles' normals times areas (m, 3).

    The wall's normals are square to it: sum A n n^T is least along it.  The section that a coarse
    mesh is cut off at is no help, for it is oblique.
    """
    area = np.linalg.norm(vectors, axis=1, keepdims=True)
    spread = vectors.T @ (vectors / np.where(area > 0.0, area, 1.0))
    axis = np.linalg.eigh(spread)[1][:, 0]
    return np.asarray(axis if axis @ vectors.sum(axis=0) >= 0.0 else -axis)


def _part(above: np.ndarray, pairs: Integers, seed: int, least: Integers) -> Integers:
    """The connected part of some triangles that holds one of them, and `least` in any case."""
    above = above.copy()
    above[least] = True
    joined = pairs[above[pairs].all(axis=1)]
    n = len(above)
    graph = csr_matrix((np.ones(len(joined)), (joined[:, 0], joined[:, 1])), shape=(n, n))
    label = connected_components(graph, directed=False)[1]
    return np.flatnonzero(above & (label == label[seed]))
