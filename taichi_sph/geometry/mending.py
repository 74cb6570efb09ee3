"""Mending of surfaces: what exporters, unions and joined patches leave behind, put right and noted.

Corners that nearly meet become one, doubled triangles and triangles without area go, a corner on
the edge of a neighbour divides it.  A sound surface comes out as it went in, to the last bit.
"""

from itertools import pairwise

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from taichi_sph.errors import InputError
from taichi_sph.geometry import mesh
from taichi_sph.geometry.mesh import Booleans, Floats, Integers

NEAR = 3e-4
"""Corners on open edges so near to another, over the surface's size, are one: six digits, which C++
writes by default, of a place thirty sizes from the origin, as in a scanner's coordinates."""
OF_AN_EDGE = 0.1
"""But never farther from it than this part of the shortest open edge: what is modelled stays."""
GRAIN = 1e-7
"""Edges shorter than this, over the surface's size, are none: single precision has 24 bits."""
FLAT = 1e-5
"""A triangle lower than this, over its longest edge, has no area: well below any that is meant,
well above what rounding to single precision makes of none."""


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def surface_size(vertices: Floats, faces: Integers) -> float:
    """Square root of a surface's area: a length that a speck far away does not change."""
    return float(np.sqrt(np.linalg.norm(mesh.face_vectors(vertices, faces), axis=1).sum()))


def mend(vertices: Floats, faces: Integers, label: str) -> tuple[Floats, Integers, list[str]]:
    """Join and leave out what does not belong to a surface's shape.

    Args:
        vertices: (n, 3), in any unit; corners may be repeated, as STL does.
        faces: Triangles, (m, 3).
        label: What a message calls the surface.

    Returns:
        vertices and triangles, and what was done, a sentence each.

    Raises:
        InputError: no triangle has an area.
    """
    mesh.log_stage(f"joining corners of {len(faces)} triangles", len(faces))
    notes: list[str] = []
    before = len(faces)
    vertices, faces = _join_equal(vertices, faces)
    size = surface_size(vertices, faces) if len(faces) else 0.0
    if size == 0.0:
        raise InputError(f"{label}: all triangles have collapsed to lines; a tube is needed")
    faces = _without_collapsed(_join_needles(vertices, faces, size))
    joined = _join_near(vertices, faces, size)
    if joined is not faces:
        moved = len(np.unique(faces)) - len(np.unique(joined))
        notes.append(f"joined: {_count(moved, 'corner')} within {NEAR:g} of the size of others")
        faces = _without_collapsed(joined)
    gone = before - len(faces)
    before = len(faces)
    faces = faces[~_doubled(faces)]
    if len(faces) < before:
        notes.append(f"left out: {_count(before - len(faces), 'triangle')} given twice")
    before = len(faces)
    faces = faces[~_needless_slivers(vertices, faces)]
    gone += before - len(faces)
    if gone:
        notes.append(f"left out: {_count(gone, 'triangle')} without area")
    divided, count = _divide_at_corners(vertices, faces, size)
    if count:
        notes.append(f"divided: {_count(count, 'edge')} on which corners of other triangles lie")
        faces = divided
    if len(faces) == 0:
        raise InputError(f"{label}: all triangles have collapsed to lines; a tube is needed")
    return *mesh.drop_unused(vertices, faces), notes


def largest_piece(
    vertices: Floats, faces: Integers, label: str
) -> tuple[Floats, Integers, list[str]]:
    """The surface without small loose pieces, and what was left out.

    Raises:
        InputError: the largest piece has less than 0.99 of the area.
    """
    count, piece = mesh.components(faces)
    if count == 1:
        return vertices, faces, []
    area = np.linalg.norm(mesh.face_vectors(vertices, faces), axis=1)
    part = np.bincount(piece, area) / area.sum()
    if part.max() < 0.99:
        raise InputError(
            f"{label}: {count} separate pieces, the largest with {100 * part.max():.0f} % of "
            f"the area; the lumen must be one connected surface{gap_hint(vertices, faces, 1.0)}"
        )
    vertices, faces = mesh.drop_unused(vertices, faces[piece == part.argmax()])
    return (
        vertices,
        faces,
        [
            f"left out: {_count(count - 1, 'small loose piece')}, {100 * (1 - part.max()):.2g} % "
            "of the area"
        ],
    )


def gap_hint(vertices: Floats, faces: Integers, scale: float) -> str:
    """A clause on corners of open edges that nearly meet others, in units of the file; or ''.

    Args:
        vertices: (n, 3).
        faces: (m, 3).
        scale: Of the vertices, over the units of the file.
    """
    edges, _, uses = mesh.edge_uses(faces)
    open_edges = edges[uses == 1]
    rim = np.unique(open_edges)
    if len(rim) < 2:
        return ""
    edge = np.linalg.norm(vertices[open_edges[:, 0]] - vertices[open_edges[:, 1]], axis=1)
    away = cKDTree(vertices[rim]).query(vertices[rim], k=2)[0][:, 1]
    near = away < 0.25 * float(np.median(edge))
    if not near.any():
        return ""
    place = ", ".join(f"{value:.4g}" for value in vertices[rim[np.argmax(near)]] / scale)
    return (
        f"; {_count(int(near.sum()), 'corner')} on open edges lie within "
        f"{away[near].max() / scale:.2g} of others, in units of the file (first at ({place})): "
        "if these are patches that nearly meet, weld them"
    )


def _join_equal(vertices: Floats, faces: Integers) -> tuple[Floats, Integers]:
    """Vertices at the same place as one, the first; those that no triangle uses go."""
    if len(faces) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    place = vertices + 0.0  # -0 is 0
    order = np.lexsort(place.T)
    new = np.ones(len(place), bool)
    new[1:] = (place[order[1:]] != place[order[:-1]]).any(axis=1)
    group = np.cumsum(new) - 1
    # lexsort is stable: the first of a group is the first of the file.
    first = np.empty(len(place), np.int64)
    first[order] = order[new][group]
    return mesh.drop_unused(vertices, _without_collapsed(first[faces]))


def _without_collapsed(faces: Integers) -> Integers:
    a, b, c = faces.T
    kept = (a != b) & (b != c) & (c != a)
    return faces if kept.all() else faces[kept]


def _joined(faces: Integers, pairs: Integers, count: int) -> Integers:
    """Triangles in which vertices that pairs (p, 2) connect are one, the first of them."""
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    _, first = np.unique(label, return_index=True)
    return np.asarray(first[label][faces], np.int64)


def _join_needles(vertices: Floats, faces: Integers, size: float) -> Integers:
    """Triangles with the ends of very short edges as one corner."""
    edges = mesh.directed_edges(faces)
    short = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1) < GRAIN * size
    return _joined(faces, edges[short], len(vertices)) if short.any() else faces


def _join_near(vertices: Floats, faces: Integers, size: float) -> Integers:
    """Triangles with corners on open edges joined to those that are very near."""
    edges, _, uses = mesh.edge_uses(faces)
    open_edges = edges[uses == 1]
    if len(open_edges) == 0:
        return faces
    lengths = np.linalg.norm(vertices[open_edges[:, 0]] - vertices[open_edges[:, 1]], axis=1)
    reach = min(NEAR * size, OF_AN_EDGE * float(lengths.min()))
    rim = np.unique(open_edges)
    pairs = rim[cKDTree(vertices[rim]).query_pairs(reach, output_type="ndarray")]
    inner = np.setdiff1d(np.unique(faces), rim, assume_unique=True)
    if len(inner):
        away, nearest = cKDTree(vertices[inner]).query(vertices[rim], distance_upper_bound=reach)
        near = np.isfinite(away)
        pairs = np.concatenate([pairs, np.stack([rim[near], inner[nearest[near]]], axis=1)])
    return _joined(faces, pairs, len(vertices)) if len(pairs) else faces


def _doubled(faces: Integers) -> Booleans:
    """Triangles that repeat the corners of an earlier one, whichever way they turn.

    Of a pair whose edges have two other triangles each, both: they are a fold with nothing in it.
    """
    corners = np.sort(faces, axis=1)
    size = int(faces.max()) + 1 if len(faces) else 1
    order = np.lexsort(corners.T)
    repeats = np.zeros(len(faces), bool)
    repeats[1:] = (corners[order[1:]] == corners[order[:-1]]).all(axis=1)
    result = np.zeros(len(faces), bool)
    result[order[repeats]] = True
    if not result.any():
        return result
    firsts = order[np.flatnonzero(~repeats)]
    twice = firsts[np.diff(np.append(np.flatnonzero(~repeats), len(faces))) > 1]
    key = _edge_keys(faces, size)
    single, uses = np.unique(key[~result], return_counts=True)
    # One of the uses is the triangle's own.
    others = uses[np.searchsorted(single, key[twice])] - 1
    result[twice[(others >= 2).all(axis=1)]] = True
    return result


def _edge_keys(faces: Integers, size: int) -> Integers:
    """A number for each undirected edge of each triangle, (m, 3)."""
    ends = np.sort(mesh.directed_edges(faces), axis=1)
    return (ends[:, 0] * size + ends[:, 1]).reshape(-1, 3)


def _heights(vertices: Floats, faces: Integers) -> tuple[Floats, Floats]:
    """Lowest height and longest edge of each triangle, (m,) each."""
    edges = mesh.directed_edges(faces)
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    longest = length.reshape(-1, 3).max(axis=1)
    area = np.linalg.norm(mesh.face_vectors(vertices, faces), axis=1)
    return 2.0 * area / np.where(longest > 0, longest, 1.0), longest


def _needless_slivers(vertices: Floats, faces: Integers) -> Booleans:
    """Triangles without area whose loss brings more edges to two triangles than it takes."""
    result = np.zeros(len(faces), bool)
    low, longest = _heights(vertices, faces)
    thin = low < FLAT * longest
    if not thin.any():
        return result
    keys = _edge_keys(faces, int(faces.max()) + 1)
    _, inverse, uses = np.unique(keys, return_inverse=True, return_counts=True)
    edge = inverse.reshape(-1, 3)
    again = True
    while again:
        again = False
        for k in np.flatnonzero(thin & ~result & (uses[edge] != 2).any(axis=1)).tolist():
            if 2 * int((uses[edge[k]] != 2).sum()) > 3:
                result[k] = again = True
                uses[edge[k]] -= 1
    return result


def _divide_at_corners(vertices: Floats, faces: Integers, size: float) -> tuple[Integers, int]:
    """Triangles divided where the corner of another lies on an open edge of theirs.

    Returns:
        The triangles, and how many edges were divided.
    """
    total = 0
    for _ in range(3):  # a triangle has three edges, and is divided at one at a time
        keys = _edge_keys(faces, int(faces.max()) + 1)
        _, inverse, uses = np.unique(keys, return_inverse=True, return_counts=True)
        row, side = np.nonzero(uses[inverse.reshape(-1, 3)] == 1)
        if len(row) == 0:
            break
        ends = np.stack([faces[row, side], faces[row, (side + 1) % 3]], axis=1)
        rim = np.unique(ends)
        start, stop = vertices[ends[:, 0]], vertices[ends[:, 1]]
        span = stop - start
        length = np.linalg.norm(span, axis=1)
        near = cKDTree(vertices[rim]).query_ball_point(
            0.5 * (start + stop), 0.5 * length + NEAR * size
        )
        edge = np.repeat(np.arange(len(row)), [len(n) for n in near])
        corner = rim[np.concatenate([np.array(n, np.int64) for n in near])]
        apart = vertices[corner] - start[edge]
        along = np.einsum("ij,ij->i", apart, span[edge]) / length[edge] ** 2
        off = np.linalg.norm(apart - along[:, None] * span[edge], axis=1)
        margin = NEAR * size / length[edge]
        hit = (off < NEAR * size) & (along > margin) & (along < 1 - margin)
        hit &= (corner[:, None] != faces[row[edge]]).all(axis=1)
        if not hit.any():
            break
        edge, corner, along = edge[hit], corner[hit], along[hit]
        made, gone = [], []
        for number in np.unique(edge).tolist():
            triangle = int(row[number])
            if triangle in gone:
                continue
            on = np.flatnonzero(edge == number)
            chain = [ends[number, 0], *corner[on[np.argsort(along[on])]], ends[number, 1]]
            tip = faces[triangle, (side[number] + 2) % 3]
            made += [(a, b, tip) for a, b in pairwise(chain)]
            gone.append(triangle)
        faces = np.concatenate([np.delete(faces, gone, axis=0), np.array(made, np.int64)])
        total += len(gone)
    return faces, total
