"""Triangle meshes as arrays: topology, caps, self-intersections, PLY files.

Everything here is geometry on ``vertices`` (n, 3) and ``faces`` (m, 3); units are the caller's.
"""

import logging
from pathlib import Path

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError, cKDTree

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]


LARGE = 100_000
"""Triangles from which on work on a surface takes seconds."""


def log_stage(stage: str, triangles: int) -> None:
    """Tell Python's log what is done next to a large surface; small ones are done at once."""
    if triangles >= LARGE:
        logging.getLogger("taichi_sph").info(stage)


def drop_unused(vertices: Floats, faces: Integers) -> tuple[Floats, Integers]:
    """Drop vertices that no triangle uses."""
    if len(faces) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    kept, renumbered, _, _ = igl.remove_unreferenced(*_contiguous(vertices, faces))
    return kept, renumbered


def _contiguous(vertices: Floats, faces: Integers) -> tuple[Floats, Integers]:
    """Arrays as libigl takes them."""
    return np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64)


def face_vectors(vertices: Floats, faces: Integers) -> Floats:
    """Normal of every triangle times its area, (m, 3)."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return 0.5 * np.cross(b - a, c - a)


def unit(vectors: Floats) -> Floats:
    """Vectors scaled to length one; a zero vector stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)


def enclosed_volume(vertices: Floats, faces: Integers) -> float:
    """Volume within a closed surface; negative where the normals point inwards."""
    # About its middle: far from the origin the parts of the sum would cancel.
    return float(igl.moments(*_contiguous(vertices - vertices.mean(axis=0), faces))[0])


def directed_edges(faces: Integers) -> Integers:
    """Edges in the order in which the triangles run through them, (3 m, 2), face by face."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def edge_uses(faces: Integers) -> tuple[Integers, Integers, Integers]:
    """Undirected edges (e, 2), the edge of each directed edge (3 m,), and each edge's uses (e,)."""
    edges = np.sort(directed_edges(faces), axis=1)
    size = int(faces.max()) + 1 if len(faces) else 1
    key, inverse, uses = np.unique(
        edges[:, 0] * size + edges[:, 1], return_inverse=True, return_counts=True
    )
    return np.stack([key // size, key % size], axis=1), inverse.reshape(-1), uses


def face_pairs(faces: Integers) -> tuple[Integers, Integers]:
    """Pairs of triangles that share an edge, (p, 2), and the edges' vertices, (p, 2)."""
    edges, inverse, uses = edge_uses(faces)
    order = np.argsort(inverse, kind="stable")
    start = np.concatenate([[0], np.cumsum(uses)[:-1]])
    shared = uses == 2
    first = order[start[shared]] // 3
    second = order[start[shared] + 1] // 3
    return np.stack([first, second], axis=1), edges[shared]


def is_winding_consistent(faces: Integers) -> bool:
    """Whether neighbouring triangles all turn the same way."""
    edges = directed_edges(faces)
    size = int(faces.max()) + 1
    key = np.sort(edges[:, 0] * size + edges[:, 1])
    return not (key[1:] == key[:-1]).any()


def is_closed(faces: Integers) -> bool:
    """Whether every edge has exactly two triangles."""
    return bool((edge_uses(faces)[2] == 2).all())


def components(faces: Integers) -> tuple[int, Integers]:
    """Number of pieces without a common vertex, and the piece of every triangle."""
    label = np.asarray(igl.vertex_components(np.ascontiguousarray(faces, np.int64))).reshape(-1)
    names, of_face = np.unique(label[faces[:, 0]], return_inverse=True)
    return len(names), of_face.reshape(-1)


def genus(faces: Integers) -> int:
    """Handles of one closed piece: 0 for a sphere, 1 for a ring."""
    return (2 - int(igl.euler_characteristic(np.ascontiguousarray(faces, np.int64)))) // 2


def boundary_loops(faces: Integers) -> list[Integers]:
    """Rims of the holes; a loop runs as the triangles along it do.

    Raises:
        ValueError: two holes touch at a vertex.
    """
    edges, inverse, uses = edge_uses(faces)
    del edges
    rim = directed_edges(faces)[uses[inverse] == 1]
    if len(np.unique(rim[:, 0])) != len(rim):
        raise ValueError("two holes touch at a vertex")
    follower = dict(rim.tolist())
    loops = []
    while follower:
        start = min(follower)
        loop = [start]
        while (after := follower.pop(loop[-1])) != start:
            loop.append(after)
            if after not in follower:
                raise ValueError("triangles along a hole do not turn the same way")
        loops.append(np.array(loop))
    return loops


def plane_axes(normal: Floats) -> tuple[Floats, Floats]:
    """Two unit vectors across a normal, along the world's axes where the normal allows."""
    first = np.zeros(3)
    first[int(np.argmin(np.abs(np.round(normal, 6))))] = 1.0
    first -= normal * (first @ normal)
    first /= np.linalg.norm(first)
    return first, np.cross(normal, first)


def loop_plane(points: Floats) -> tuple[Floats, Floats, float]:
    """Centre, unit normal (right-handed about the loop) and area of a closed polygon (n, 3)."""
    origin = points.mean(axis=0)
    a = points - origin
    b = np.roll(a, -1, axis=0)
    cross = 0.5 * np.cross(a, b)
    vector = cross.sum(axis=0)
    area = float(np.linalg.norm(vector))
    if area == 0.0:
        return origin, np.zeros(3), 0.0
    normal = vector / area
    weight = cross @ normal
    centre = origin + ((a + b) / 3.0 * weight[:, None]).sum(axis=0) / weight.sum()
    return centre, normal, area


def inside_polygon(points: Floats, polygon: Floats) -> Booleans:
    """Which points (k, 2) lie within a closed polygon (n, 2)."""
    result = np.zeros(len(points), bool)
    x, y = points[:, 0], points[:, 1]
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if y0 == y1:
            continue
        crosses = (y0 > y) != (y1 > y)
        result ^= crosses & (x < (x1 - x0) * (y - y0) / (y1 - y0) + x0)
    return result


def cut_ears(polygon: Floats) -> Integers:
    """Triangles of a simple polygon (n, 2) that turns left, by cutting ears."""
    rest = list(range(len(polygon)))
    triangles = []

    def turn(a: int, b: int, c: int) -> float:
        p, q, r = polygon[a], polygon[b], polygon[c]
        return float((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]))

    while len(rest) > 3:
        best, best_quality = -1, -np.inf
        for k in range(len(rest)):
            a, b, c = rest[k - 1], rest[k], rest[(k + 1) % len(rest)]
            area = turn(a, b, c)
            if area <= 0:
                continue
            p, q, r = polygon[a], polygon[b], polygon[c]
            longest = max(((p - q) ** 2).sum(), ((q - r) ** 2).sum(), ((r - p) ** 2).sum())
            quality = area / longest
            if quality <= best_quality:
                continue
            others = polygon[[v for v in rest if v not in (a, b, c)]]
            sides = [
                (e[0] - s[0]) * (others[:, 1] - s[1]) - (e[1] - s[1]) * (others[:, 0] - s[0]) >= 0
                for s, e in ((p, q), (q, r), (r, p))
            ]
            if not (sides[0] & sides[1] & sides[2]).any():
                best, best_quality = k, quality
        if best < 0:
            raise ValueError("the rim crosses itself")
        triangles.append((rest[best - 1], rest[best], rest[(best + 1) % len(rest)]))
        del rest[best]
    triangles.append((rest[0], rest[1], rest[2]))
    return np.array(triangles)


def fill_polygon(rim: Floats) -> tuple[Floats, Integers]:
    """Triangulate a nearly flat polygon (n, 3), its normal right-handed about it.

    Returns:
        Extra points (k, 3) in the polygon's plane, and triangles (t, 3) over rim, then extras.

    Raises:
        ValueError: the polygon crosses itself.
    """
    centre, normal, area = loop_plane(rim)
    first, second = plane_axes(normal)
    flat = np.stack([(rim - centre) @ first, (rim - centre) @ second], axis=1)
    edge = np.linalg.norm(np.roll(flat, -1, axis=0) - flat, axis=1)
    step = max(float(np.median(edge)), np.sqrt(area / 2000.0))
    low, high = flat.min(axis=0), flat.max(axis=0)
    rows = np.arange(low[1], high[1], step * np.sqrt(0.75))
    columns = np.arange(low[0], high[0] + step, step)
    grid = np.stack(np.meshgrid(columns, rows), axis=-1)
    grid[1::2, :, 0] += 0.5 * step
    inner = grid.reshape(-1, 2)
    inner = inner[inside_polygon(inner, flat)]
    # Measured from a densely sampled rim, so that no lattice point crowds it.
    share = (np.arange(4) / 4.0)[None, :, None]
    dense = flat[:, None] * (1 - share) + np.roll(flat, -1, axis=0)[:, None] * share
    if len(inner):
        inner = inner[cKDTree(dense.reshape(-1, 2)).query(inner)[0] > 0.65 * step]
    points = np.concatenate([flat, inner])
    triangles = None
    if len(rim) > 3:
        try:
            triangles = _check_fill(points, Delaunay(points).simplices, flat, area)
        except QhullError:
            triangles = None
    if triangles is None:
        return np.zeros((0, 3)), cut_ears(flat)
    return centre + inner[:, :1] * first + inner[:, 1:] * second, triangles


def _check_fill(
    points: Floats, triangles: NDArray[np.int32], polygon: Floats, area: float
) -> Integers | None:
    """The triangles within the polygon, turning left; None where they miss an edge of the rim."""
    kept = triangles[inside_polygon(points[triangles].mean(axis=1), polygon)].astype(np.int64)
    if len(kept) == 0:
        return None
    a, b, c = (points[kept[:, k]] for k in range(3))
    double = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    kept[double < 0] = kept[double < 0][:, ::-1]
    kept = kept[np.abs(double) > 1e-9 * area]
    count = len(polygon)
    edges, inverse, uses = edge_uses(kept)
    rim = {tuple(sorted((k, (k + 1) % count))) for k in range(count)}
    single = {tuple(edge) for edge in edges[uses == 1].tolist()}
    whole = abs(0.5 * np.abs(double).sum() - area) < 1e-6 * area
    del inverse
    return kept if whole and single == rim and is_winding_consistent(kept) else None


def region_plane(vertices: Floats, faces: Integers) -> tuple[Floats, Floats, float]:
    """Centre, mean unit normal and area of a flat set of triangles."""
    vectors = face_vectors(vertices, faces)
    area = np.linalg.norm(vectors, axis=1)
    centre = (vertices[faces].mean(axis=1) * area[:, None]).sum(axis=0) / area.sum()
    return centre, unit(vectors.sum(axis=0)), float(area.sum())


def self_intersections(vertices: Floats, faces: Integers) -> Integers:
    """Triangles that cut through another or are cut, but for those that only touch, (k,)."""
    corners = vertices[faces]
    centre = corners.mean(axis=1)
    radius = np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1)
    low, high = corners.min(axis=1), corners.max(axis=1)
    # Triangles by size class, so that one large triangle does not widen everyone's search.
    level = np.floor(np.log2(np.maximum(radius, radius.max() * 1e-6))).astype(int)
    classes = [np.flatnonzero(level == k) for k in np.unique(level)]
    trees = [cKDTree(centre[members]) for members in classes]
    bad = np.zeros(len(faces), bool)
    for i, members in enumerate(classes):
        for j in range(i, len(classes)):
            other = classes[j]
            reach = radius[members].max() + radius[other].max()
            for first in range(0, len(members), AT_ONCE):
                part = members[first : first + AT_ONCE]
                pairs = cKDTree(centre[part]).sparse_distance_matrix(
                    trees[j], reach, output_type="ndarray"
                )
                p, q = part[pairs["i"]], other[pairs["j"]]
                if i == j:
                    p, q = p[p < q], q[p < q]
                for axis in range(3):
                    near = (low[p, axis] <= high[q, axis]) & (low[q, axis] <= high[p, axis])
                    p, q = p[near], q[near]
                _mark_crossings(corners, faces, p, q, bad)
    return np.flatnonzero(bad)


AT_ONCE = 20_000
"""Triangles whose neighbours are looked at together: some 50 MB."""


def _mark_crossings(
    corners: Floats, faces: Integers, p: Integers, q: Integers, bad: Booleans
) -> None:
    """Mark triangle pairs of which an edge of one pierces the other, without a common vertex."""
    for first, second in ((p, q), (q, p)):
        # Most lie on one side of the other's plane, which spares a closer look.
        origin = corners[second, 0]
        normal = np.cross(corners[second, 1] - origin, corners[second, 2] - origin)
        height = np.stack(
            [np.einsum("ij,ij->i", corners[first, k] - origin, normal) for k in range(3)]
        )
        across = (height < 0).any(axis=0) & (height > 0).any(axis=0)
        _mark_pierced(corners, faces, first[across], second[across], bad)


def _mark_pierced(
    corners: Floats, faces: Integers, p: Integers, q: Integers, bad: Booleans
) -> None:
    """Mark triangle pairs in which an edge of p pierces q and shares no vertex with it."""
    for k in range(3):
        ends = faces[p][:, [k, (k + 1) % 3]]
        free = ~(ends[:, :, None] == faces[q][:, None, :]).any(axis=(1, 2))
        a, b = corners[p[free], k], corners[p[free], (k + 1) % 3]
        t = corners[q[free]]
        normal = np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
        before = np.einsum("ij,ij->i", a - t[:, 0], normal)
        after = np.einsum("ij,ij->i", b - t[:, 0], normal)
        # Neighbours in a flat cap touch but for rounding: that is no crossing.
        slack = 1e-5 * np.linalg.norm(b - a, axis=1) * np.linalg.norm(normal, axis=1)
        direction = b - a
        volume = [
            np.einsum("ij,ij->i", direction, np.cross(t[:, m] - a, t[:, (m + 1) % 3] - a))
            for m in range(3)
        ]
        same = [(v > 0) for v in volume]
        strict = (volume[0] != 0) & (volume[1] != 0) & (volume[2] != 0)
        through = (np.minimum(before, after) < -slack) & (np.maximum(before, after) > slack)
        pierced = through & strict & (same[0] == same[1]) & (same[1] == same[2])
        bad[p[free][pierced]] = True
        bad[q[free][pierced]] = True


class NearestPoint:
    """Nearest places on a mesh; the tree over its triangles is built once."""

    def __init__(self, vertices: Floats, faces: Integers):
        """Build the tree over triangles `faces` (m, 3) of `vertices` (n, 3)."""
        self.vertices = np.ascontiguousarray(vertices, np.float64)
        self.faces = np.ascontiguousarray(faces, np.int64)
        self._tree = igl.AABB()
        self._tree.init(self.vertices, self.faces)

    def __call__(self, points: Floats) -> tuple[Floats, Integers, Floats]:
        """Distance (k,), triangle (k,) and place (k, 3) nearest to points (k, 3)."""
        if len(points) == 0:
            return np.zeros(0), np.zeros(0, np.int64), np.zeros((0, 3))
        points = np.ascontiguousarray(points, np.float64)
        square, triangle, place = self._tree.squared_distance(self.vertices, self.faces, points)
        return np.sqrt(square), triangle, place


def vertex_normals(vertices: Floats, faces: Integers) -> Floats:
    """Unit normal at each vertex (n, 3): the mean over its triangles, weighted by area.

    libigl's differ in the last bit, and with them the proxies of every shipped scene.
    """
    vectors = face_vectors(vertices, faces)
    normals = np.zeros_like(vertices)
    for k in range(3):
        for axis in range(3):
            normals[:, axis] += np.bincount(faces[:, k], vectors[:, axis], len(vertices))
    return unit(normals)


def corner_normals(vertices: Floats, faces: Integers) -> Floats:
    """Unit normal at each corner of each triangle (m, 3, 3): smooth, except over sharp edges."""
    own = unit(face_vectors(vertices, faces))
    corner = vertex_normals(vertices, faces)[faces]
    sharp = np.einsum("mkc,mc->mk", corner, own) < np.cos(np.radians(35.0))
    return np.where(sharp[:, :, None], own[:, None, :], corner)


def ply_bytes(vertices: Floats, faces: Integers, comment: str = "") -> bytes:
    """A binary little-endian PLY file; the same mesh gives the same bytes."""
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {comment}"] if comment else []
    lines += [f"element vertex {len(vertices)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    rows = np.zeros(len(faces), dtype=[("count", "u1"), ("corner", "<i4", 3)])
    rows["count"] = 3
    rows["corner"] = faces
    header = ("\n".join(lines) + "\n").encode("ascii")
    return header + vertices.astype("<f4").tobytes() + rows.tobytes()


def write_ply(path: Path, vertices: Floats, faces: Integers, comment: str = "") -> None:
    """Write `ply_bytes` to a file."""
    path.write_bytes(ply_bytes(vertices, faces, comment))
