"""Surfaces of branching vessels: marching cubes over a smooth union, cut flat at the openings."""

import math

import igl
import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from app.scenes.smooth_union import SmoothUnion
from app.scenes.vessel_table import Centrelines, End
from taichi_sph.errors import InputError
from taichi_sph.geometry import mesh
from taichi_sph.geometry.mesh import Booleans, Floats, Integers

TRIANGLES = 22_000
"""Triangles of a generated vessel, about."""
_FINER = 0.65
"""Marching cubes run on a grid this much finer; short edges then collapse to even triangles."""
REACH = 3.0
"""A prolonged end is no farther from its opening's middle [radii]: it is a radius long and ends in
a ball of a radius or so."""


def cap_all(vertices: Floats, faces: Integers, name: str) -> tuple[Floats, Integers]:
    """Fill every hole flat.

    Raises:
        InputError: a hole is not the end of a tube.
    """
    try:
        for loop in mesh.boundary_loops(faces):
            rim = loop[::-1]
            extra, cap = mesh.fill_polygon(vertices[rim])
            number = np.concatenate([rim, len(vertices) + np.arange(len(extra))])
            vertices = np.concatenate([vertices, extra])
            faces = np.concatenate([faces, number[cap]])
    except ValueError as error:
        raise InputError(
            f"{name}: {error}: another branch passes through an opening; move one of them"
        ) from None
    return vertices, faces


def branching(shape: Centrelines) -> tuple[Floats, Integers]:
    """Closed surface of a branching vessel: vertices (n, 3) [mm] and outward triangles (m, 3).

    Raises:
        InputError: the table contradicts itself, or an end cannot be cut off and closed.
    """
    distance = SmoothUnion(shape)
    area = sum(
        math.pi * (a[3] + b[3]) * math.dist(a[:3], b[:3])
        for branch in shape.branches
        for a, b in zip(branch.points, branch.points[1:], strict=False)
    )
    edge = math.sqrt(area / TRIANGLES * 4 / math.sqrt(3))
    vertices, faces = _march(distance, shape, _FINER * edge)
    for _ in range(2):
        vertices = distance.settle(vertices, faces, _FINER * edge)
    target = min(len(faces), round(TRIANGLES * 1.1))
    vertices, faces, _, _ = igl.decimate(vertices, faces, target)
    vertices, faces = mesh.drop_unused(vertices, np.asarray(faces, np.int64))
    free = np.ones(len(vertices), bool)
    for _ in range(6):
        vertices = distance.settle(_relax(vertices, faces, free), faces, edge)
    for end in shape.openings:
        vertices, faces = _cut(vertices, faces, end, distance, edge)
    faces = _merge_short_rims(vertices, faces, 0.35 * edge)
    vertices, faces = mesh.drop_unused(vertices, faces)
    # What the cuts left uneven is relaxed; the rims stay.
    free = np.ones(len(vertices), bool)
    for loop in mesh.boundary_loops(faces):
        free[loop] = False
    for _ in range(4):
        moved = distance.settle(_relax(vertices, faces, free), faces, edge)
        vertices = np.where(free[:, None], moved, vertices)
    vertices[free] = distance.project(vertices[free], edge, rounds=2)
    return cap_all(vertices, faces, shape.name)


def _merge_short_rims(vertices: Floats, faces: Integers, least: float) -> Integers:
    """Merge neighbours on a rim that are closer than `least` [mm]; the new triangles."""
    for loop in mesh.boundary_loops(faces):
        goal = np.arange(len(vertices))
        before = loop[-1]
        for k, here in enumerate(loop):
            after = loop[(k + 1) % len(loop)]
            # Two merged edges never touch, so that each merge is of one triangle's edge.
            short = np.linalg.norm(vertices[here] - vertices[after]) < least
            if short and goal[here] == here and goal[before] == before and after != loop[0]:
                goal[after] = here
            before = here
        faces = goal[faces]
        a, b, c = faces.T
        faces = faces[(a != b) & (b != c) & (c != a)]
    return faces


def _march(distance: SmoothUnion, shape: Centrelines, size: float) -> tuple[Floats, Integers]:
    """Marching cubes on a grid of that size [mm], exact values near the surface only."""
    # Balls that hold the branches (1.6 for the major axis and the smooth union), their prolonged
    # ends and the bulges.
    balls = np.concatenate(
        [
            *(np.array(branch.points) * [1, 1, 1, 1.6] for branch in shape.branches),
            *(np.array([(*end.centre, 2.5 * end.radius)]) for end in shape.openings),
            *(np.array([bulge.sphere]) * [1, 1, 1, 1.6] for bulge in shape.extras),
        ]
    )
    low = (balls[:, :3] - balls[:, 3:]).min(axis=0)
    high = (balls[:, :3] + balls[:, 3:]).max(axis=0)
    factor = 3
    coarse_shape = np.ceil((high - low) / (factor * size)).astype(int) + 1
    coarse = low + factor * size * np.moveaxis(np.indices(coarse_shape), 0, -1)
    values = distance(coarse.reshape(-1, 3)).reshape(coarse_shape)
    fine_shape = factor * (coarse_shape - 1) + 1
    fine = ndimage.zoom(values, fine_shape / coarse_shape, order=1)
    # A fine node is evaluated where the surface may pass beside it, by its nearest coarse node.
    near = np.abs(values) < (0.5 * math.sqrt(3) * factor + 1.4) * size
    near_fine = ndimage.zoom(near.astype(np.uint8), fine_shape / coarse_shape, order=0) > 0
    index = np.argwhere(near_fine)
    fine[near_fine] = distance(low + size * index)
    nodes = low + size * np.moveaxis(np.indices(fine.shape), 0, -1)
    nx, ny, nz = fine.shape
    # libigl counts x fastest.
    vertices, faces, _ = igl.marching_cubes(
        np.ascontiguousarray(fine.transpose(2, 1, 0).reshape(-1)),
        np.ascontiguousarray(nodes.transpose(2, 1, 0, 3).reshape(-1, 3)),
        nx,
        ny,
        nz,
        0.0,
    )
    faces = np.asarray(faces, np.int64)
    if mesh.enclosed_volume(vertices, faces) < 0:
        faces = faces[:, ::-1].copy()
    return vertices, faces


def _relax(vertices: Floats, faces: Integers, free: Booleans) -> Floats:
    """Move free vertices half-way to the area-weighted middle of their triangles, tangentially."""
    vectors = mesh.face_vectors(vertices, faces)
    area = np.linalg.norm(vectors, axis=1)
    middle = vertices[faces].mean(axis=1) * area[:, None]
    total = np.zeros(len(vertices))
    target = np.zeros_like(vertices)
    for k in range(3):
        total += np.bincount(faces[:, k], area, len(vertices))
        for axis in range(3):
            target[:, axis] += np.bincount(faces[:, k], middle[:, axis], len(vertices))
    move = target / np.maximum(total, 1e-300)[:, None] - vertices
    normal = mesh.vertex_normals(vertices, faces)
    move -= np.einsum("ij,ij->i", move, normal)[:, None] * normal
    return vertices + np.where(free[:, None], 0.5 * move, 0.0)


def _to_rim(points: Floats, end: End, distance: SmoothUnion, edge: float) -> Floats:
    """Bring points onto the curve in which an opening's plane meets the surface."""
    centre, normal = np.array(end.centre), mesh.unit(np.array(end.normal))
    for _ in range(6):
        points = points - ((points - centre) @ normal)[:, None] * normal
        value, slope = distance(points), distance.gradient(points, 0.05 * edge)
        slope = slope - (slope @ normal)[:, None] * normal
        square = np.maximum(np.einsum("ij,ij->i", slope, slope), 0.1)
        points = points - np.clip(value / square, -edge, edge)[:, None] * slope
    return points - ((points - centre) @ normal)[:, None] * normal


def _beyond(vertices: Floats, faces: Integers, end: End, height: Floats, edge: float) -> Booleans:
    """Which vertices are the prolonged end's, at its opening's plane or beyond, (n,).

    Another branch may pass as near; what counts is what hangs together with the end's tip.

    Raises:
        InputError: another branch has grown together with the prolonged end.
    """
    away = np.linalg.norm(vertices - np.array(end.centre), axis=1)
    near = (away < REACH * end.radius) & (height > -0.35 * edge)
    tip = np.array(end.centre) + end.radius * mesh.unit(np.array(end.normal))
    start = int(np.where(near, np.linalg.norm(vertices - tip, axis=1), np.inf).argmin())
    edges = mesh.directed_edges(faces)
    edges = edges[near[edges].all(axis=1)]
    graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(len(vertices),) * 2)
    part = connected_components(graph, directed=False)[1]
    own = near & (part == part[start])
    if (away[own] > (REACH - 0.1) * end.radius).any():
        raise InputError(
            f"openings: {end.name!r} cannot be cut off: another branch runs into its prolonged "
            f"end within {REACH:g} radii; move the opening back, or the branch away"
        )
    return own


def _cut(
    vertices: Floats, faces: Integers, end: End, distance: SmoothUnion, edge: float
) -> tuple[Floats, Integers]:
    """Cut the prolonged end of a branch off by its opening's plane, near the opening only."""
    centre, normal = np.array(end.centre), mesh.unit(np.array(end.normal))
    height = (vertices - centre) @ normal
    local = _beyond(vertices, faces, end, height, edge)
    # Vertices near the plane move onto the rim, so that the cut leaves no slivers.
    close = np.flatnonzero(local & (np.abs(height) < 0.35 * edge))
    vertices = vertices.copy()
    vertices[close] = _to_rim(vertices[close], end, distance, edge)
    height[close] = 0.0
    side = np.where(local, np.sign(height), -1.0).astype(int)
    corner = side[faces]
    crossing = ((corner > 0).any(axis=1)) & ((corner < 0).any(axis=1))
    edges = np.sort(mesh.directed_edges(faces[crossing]), axis=1)
    edges = np.unique(edges[side[edges[:, 0]] * side[edges[:, 1]] < 0], axis=0)
    share = height[edges[:, 0]] / (height[edges[:, 0]] - height[edges[:, 1]])
    added = vertices[edges[:, 0]] + share[:, None] * (vertices[edges[:, 1]] - vertices[edges[:, 0]])
    new = {(int(a), int(b)): len(vertices) + k for k, (a, b) in enumerate(edges)}
    vertices = np.concatenate([vertices, _to_rim(added, end, distance, edge)])
    kept = [faces[(corner <= 0).all(axis=1) & (corner < 0).any(axis=1)]]
    for face in faces[crossing].tolist():
        polygon = []
        for a, b in zip(face, face[1:] + face[:1], strict=True):
            if side[a] <= 0:
                polygon.append(a)
            if side[a] * side[b] < 0:
                polygon.append(new[(min(a, b), max(a, b))])
        if len(polygon) == 4:
            p = vertices[polygon]
            # Split along the shorter diagonal.
            if np.linalg.norm(p[0] - p[2]) > np.linalg.norm(p[1] - p[3]):
                polygon = polygon[1:] + polygon[:1]
        kept += [
            np.array([[polygon[0], polygon[k], polygon[k + 1]]]) for k in range(1, len(polygon) - 1)
        ]
    faces = np.concatenate(kept)
    count, piece = mesh.components(faces)
    if count > 1:
        # The rounded tip can leave crumbs just at the plane; the lumen is the large piece.
        faces = faces[piece == np.bincount(piece).argmax()]
    return vertices, faces
