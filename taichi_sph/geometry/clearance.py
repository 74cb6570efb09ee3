"""The narrowest place on the way from one opening of a lumen to another."""

from collections.abc import Callable

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from taichi_sph.geometry.mesh import (
    Booleans,
    Floats,
    Integers,
    NearestPoint,
    face_vectors,
    plane_axes,
    unit,
)
from taichi_sph.geometry.wall_sampling import stratified_points

End = tuple[Floats, Floats, float]
"""Centre, outward unit normal and radius of an opening."""


def narrowest_place(
    vertices: Floats,
    faces: Integers,
    wall: Integers,
    ends: list[End],
    contains: Callable[[Floats], Booleans],
) -> tuple[float, int]:
    """Radius of the largest ball that passes from the first opening to all others.

    A path along the middle is found on a coarse lattice; at each of its stations, and in the
    openings' planes, the largest clearance in the section across is then searched.

    Args:
        vertices: Of the surface (n, 3).
        faces: Its triangles (m, 3).
        wall: Triangles without the openings' caps (w, 3).
        ends: The openings.
        contains: Which points (k, 3) lie within the lumen.

    Returns:
        The radius, and the number of the opening that it is in or on the way to.
    """
    nearest_on = NearestPoint(vertices, wall)

    def clearance(points: Floats) -> Floats:
        return nearest_on(points)[0]

    low, high = vertices.min(axis=0), vertices.max(axis=0)
    size = min([radius for _, _, radius in ends], default=float((high - low).min()) / 2) / 3
    area = float(np.linalg.norm(face_vectors(vertices, faces), axis=1).sum())
    least, narrow_end = np.inf, 0
    for _ in range(3):
        size = max(size, float(np.prod(high - low) / 2e6) ** (1 / 3))
        shape = np.ceil((high - low) / size).astype(int)
        corner = 0.5 * (low + high) - 0.5 * size * shape
        skin = stratified_points(vertices, faces, int(6 * area / size**2) + 1, seed=0)
        inside = _inside_cells(skin, contains, corner, shape, size)
        places = corner + (np.argwhere(inside) + 0.5) * size
        if len(places) == 0:
            size /= 2
            continue
        clearances = clearance(places)
        if not ends:
            best = places[np.argsort(clearances)[-20:]]
            widest = maximise_clearance(best, np.zeros_like(best), size, clearance)
            return float(widest.max()), 0
        centres, normals, radii = (np.array(part) for part in zip(*ends, strict=True))
        at_ends = maximise_clearance(centres, normals, 0.5 * radii, clearance)
        least, narrow_end = float(at_ends.min()), int(at_ends.argmin())
        paths = _paths(inside, places, clearances, ends, size)
        if paths is not None:
            for end, points, tangents in paths:
                # From the tightest on; a station roomier than the least so far cannot matter.
                before = clearance(points)
                for some in np.array_split(np.argsort(before), max(1, len(points) // 10)):
                    some = some[before[some] < least]
                    if len(some) == 0:
                        break
                    widest = maximise_clearance(points[some], tangents[some], size, clearance)
                    if widest.min() < least:
                        least, narrow_end = float(widest.min()), end
            return least, narrow_end
        size /= 2
    # Closed but for a gap finer than the lattice.
    return min(least, size), narrow_end


def _inside_cells(
    skin: Floats,
    contains: Callable[[Floats], Booleans],
    corner: Floats,
    shape: Integers,
    size: float,
) -> Booleans:
    """Cells whose middle lies within the lumen; only those near the skin or enclosed are asked."""
    closed = np.zeros(shape, bool)
    closed[tuple(np.clip(((skin - corner) / size).astype(int), 0, shape - 1).T)] = True
    closed = np.pad(ndimage.binary_dilation(closed), 1)
    label, _ = ndimage.label(~closed)
    ask = (label != label[0, 0, 0])[1:-1, 1:-1, 1:-1]
    result = np.zeros(shape, bool)
    result[ask] = contains(corner + (np.argwhere(ask) + 0.5) * size)
    return result


def _paths(
    inside: Booleans, places: Floats, clearances: Floats, ends: list[End], size: float
) -> list[tuple[int, Floats, Floats]] | None:
    """Number, points and directions of the way from the first end to each other.

    None where one is cut off.
    """
    number = np.full(inside.shape, -1)
    number[inside] = np.arange(len(places))
    rows, columns, weights = [], [], []
    for shift in np.ndindex(3, 3, 3):
        step = np.array(shift) - 1
        if tuple(step) <= (0, 0, 0):
            continue
        extents = list(zip(step, inside.shape, strict=True))
        here = tuple(slice(max(0, -s), n - max(0, s)) for s, n in extents)
        there = tuple(slice(max(0, s), n - max(0, -s)) for s, n in extents)
        a, b = number[here].reshape(-1), number[there].reshape(-1)
        both = (a >= 0) & (b >= 0)
        a, b = a[both], b[both]
        rows.append(a)
        columns.append(b)
        # Dear where it is narrow, so that the way keeps to the middle.
        tight = np.minimum(clearances[a], clearances[b]) + 0.05 * size
        weights.append(float(np.linalg.norm(step)) * (size / tight) ** 3)
    graph = coo_matrix(
        (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))),
        shape=(len(places), len(places)),
    ).tocsr()
    end_cells = []
    for centre, normal, radius in ends:
        apart = places - centre
        near = np.linalg.norm(apart, axis=1) < 2.0 * radius
        near &= -(apart @ normal) < 2.0 * size
        if not near.any():
            return None
        members = np.flatnonzero(near)
        end_cells.append(int(members[np.argmax(clearances[members])]))
    cost, before = dijkstra(graph, directed=False, indices=end_cells[0], return_predecessors=True)
    if not np.isfinite(cost[end_cells]).all():
        return None
    paths = []
    for end, cell in enumerate(end_cells[1:], 1):
        way = [cell]
        while way[-1] != end_cells[0]:
            way.append(int(before[way[-1]]))
        if len(way) < 3:
            continue
        points = ndimage.gaussian_filter1d(places[way], 1.5, axis=0, mode="nearest")
        paths.append((end, points, unit(np.gradient(points, axis=0))))
    return paths


def maximise_clearance(
    points: Floats,
    normals: Floats,
    reach: float | Floats,
    clearance: Callable[[Floats], Floats],
) -> Floats:
    """Largest clearance within `reach` of each point (k, 3), across its normal (k, 3), (k,).

    Zero normals search in all directions.
    """
    line = np.linspace(-1.0, 1.0, 7)
    disc = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    ball = np.stack(np.meshgrid(line, line, line), axis=-1).reshape(-1, 3)
    offsets = np.array(
        [disc @ np.array(plane_axes(n)) if n.any() else ball for n in normals]
    ) * np.broadcast_to(reach, len(points)).reshape(-1, 1, 1)
    rows = np.arange(len(points))
    for _ in range(4):
        tries = points[:, None] + offsets
        found = clearance(tries.reshape(-1, 3)).reshape(tries.shape[:2])
        chosen = found.argmax(axis=1)
        points = tries[rows, chosen]
        offsets = 0.35 * offsets
    return found[rows, chosen]
