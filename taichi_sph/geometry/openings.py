"""Openings of a lumen surface: finding flat ends, capping open ones.

Mistakes in the file are errors that say what was found and what to change.
"""

import math
from dataclasses import dataclass

import numpy as np

from taichi_sph.errors import InputError
from taichi_sph.geometry import mesh
from taichi_sph.geometry.mesh import Floats, Integers
from taichi_sph.geometry.surface_file import where


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


def is_round(vertices: Floats, faces: Integers, roundness: float) -> bool:
    """Whether 4 pi area / rim^2 of a flat region reaches a value: a disc 1, a square 0.785."""
    edges, _, uses = mesh.edge_uses(faces)
    rim = vertices[edges[uses == 1]]
    around = float(np.linalg.norm(rim[:, 0] - rim[:, 1], axis=1).sum())
    area = float(np.linalg.norm(mesh.face_vectors(vertices, faces), axis=1).sum())
    return 4 * math.pi * area > roundness * around**2
