"""Openings of a lumen surface: its capped ends and its open ones, which are capped here.

An opening is its rim: a cap that is not flat is taken out and made anew, flat, within it.
Mistakes in the file are errors that say what was found and what to change.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from taichi_sph.errors import InputError
from taichi_sph.geometry import caps, mesh
from taichi_sph.geometry.caps import OVAL, STEEP, Cap
from taichi_sph.geometry.mesh import Floats, Integers
from taichi_sph.geometry.surface_file import where
from taichi_sph.geometry.tips import Tip, find_tips

FEWEST_EDGES = 6
"""A hole of fewer edges is a triangle or two that are missing, no end of a tube."""


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
    """An end found on a surface, flat by now, not yet named."""

    centre: Floats
    normal: Floats
    area: float
    faces: Integers
    from_hole: bool
    """Whether it was open."""
    bulge: float = 0.0
    """How far its cap stood off the plane of its rim before it was made anew [radii]."""

    @property
    def radius(self) -> float:
        """Radius of the circle of equal area."""
        return math.sqrt(self.area / math.pi)


@dataclass(frozen=True, eq=False)
class Ends:
    """A surface, closed, and its ends."""

    vertices: Floats
    faces: Integers
    found: list[Candidate]
    """Those from holes first, each group by area."""
    doubtful: list[Cap]
    """Ends with a sharp rim that are no opening: domes and what is far from round."""
    blind: list[Tip]
    """Ends of branches that are closed and have no rim; empty where they were not looked for."""


def close_holes(
    vertices: Floats, faces: Integers, label: str, scale: float = 1.0
) -> tuple[Floats, Integers, list[Candidate]]:
    """Cap the open ends of a tube flat.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3), outward.
        label: What messages call the surface.
        scale: Metres per unit of the file, in which messages give places.

    Raises:
        InputError: a hole is not the end of a tube.
    """
    return _close(vertices, faces, label, scale, {})


def _close(
    vertices: Floats, faces: Integers, label: str, scale: float, bulges: dict[int, float]
) -> tuple[Floats, Integers, list[Candidate]]:
    """`close_holes`; `bulges` has the caps that were taken out, by the first vertex of the rim."""
    try:
        loops = mesh.boundary_loops(faces)
    except ValueError as error:
        raise InputError(f"{label}: {error}; close the holes or cut the ends flat") from None
    if not loops:
        return vertices, faces, []
    wall_normal = mesh.unit(mesh.face_vectors(vertices, faces))
    edge_of = {tuple(edge): k // 3 for k, edge in enumerate(mesh.directed_edges(faces).tolist())}
    extent = float(np.ptp(vertices, axis=0).max())
    _refuse_concentric(vertices, loops, label, scale)
    found = []
    for loop in loops:
        beside = [edge_of[(int(a), int(b))] for a, b in zip(loop, np.roll(loop, -1), strict=True)]
        bulge = bulges.get(int(loop.min()))
        reason = _why_no_end(vertices[loop[::-1]], wall_normal[beside], extent, bulge is not None)
        centre, _, area = mesh.loop_plane(vertices[loop[::-1]])
        place = f"{where(centre / scale)} in units of the file"
        if reason:
            radius = math.sqrt(area / math.pi) / scale
            raise InputError(
                f"{label}: a hole of radius {radius:.3g} at {place} is not the end of a tube "
                f"({reason}); close it, or cut the end flat"
            )
        vertices, strip, ring = _level(vertices, loop[::-1])
        faces = np.concatenate([faces, strip])
        try:
            extra, cap = mesh.fill_polygon(vertices[ring])
        except ValueError as error:
            raise InputError(f"{label}: the hole at {place}: {error}") from None
        number = np.concatenate([ring, len(vertices) + np.arange(len(extra))])
        vertices = np.concatenate([vertices, extra])
        members = len(faces) + np.arange(len(cap))
        faces = np.concatenate([faces, number[cap]])
        centre, normal, area = mesh.loop_plane(vertices[ring])
        found.append(Candidate(centre, normal, area, members, bulge is None, bulge or 0.0))
    return vertices, faces, found


def _why_no_end(rim: Floats, wall_normals: Floats, extent: float, was_cap: bool) -> str:
    """Why a hole within a rim (n, 3) is not the end of a tube; empty where it is one."""
    centre, normal, area = mesh.loop_plane(rim)
    around = float(np.linalg.norm(np.roll(rim, -1, axis=0) - rim, axis=1).sum())
    radius = math.sqrt(area / math.pi)
    reason = ""
    if (len(rim) < FEWEST_EDGES and not was_cap) or radius < 1e-3 * extent:
        reason = f"it has {len(rim)} edges"
    elif 4 * math.pi * area < OVAL * around**2:
        reason = "its rim is not round"
    elif np.ptp((rim - centre) @ normal) > 0.5 * radius:
        reason = "its rim is not flat"
    elif float(np.abs(wall_normals @ normal).mean()) > STEEP:
        reason = "the wall lies in its plane"
    return reason


def _level(vertices: Floats, ring: Integers) -> tuple[Floats, Integers, Integers]:
    """Make a rim flat: the vertices, triangles that this adds, and the flat rim's vertices."""
    rim = vertices[ring]
    centre, normal, area = mesh.loop_plane(rim)
    radius = math.sqrt(area / math.pi)
    height = (rim - centre) @ normal
    if np.ptp(height) <= caps.FLAT * radius:
        vertices = vertices.copy()
        vertices[ring] -= height[:, None] * normal
        return vertices, np.zeros((0, 3), np.int64), ring
    # An uneven rim is carried on along the normal to a flat one; the strip is wall.
    around = float(np.linalg.norm(np.roll(rim, -1, axis=0) - rim, axis=1).sum())
    level = float(height.max()) + 0.25 * around / len(ring)
    lifted = rim + (level - height)[:, None] * normal
    upper = len(vertices) + np.arange(len(ring))
    after, above = np.roll(ring, -1), np.roll(upper, -1)
    strip = np.concatenate([np.stack([ring, after, above], 1), np.stack([ring, above, upper], 1)])
    return np.concatenate([vertices, lifted]), strip, upper


def _refuse_concentric(vertices: Floats, loops: list[Integers], label: str, scale: float) -> None:
    """Refuse two open rims in one plane of which one lies in the other: the ends of a wall.

    Raises:
        InputError: there are two such.
    """
    planes = [mesh.loop_plane(vertices[loop]) for loop in loops]
    for centre, normal, area in planes:
        radius = math.sqrt(area / math.pi)
        for other, axis, less in planes:
            apart = other - centre
            height = abs(float(apart @ normal))
            aside = math.sqrt(max(float(apart @ apart) - height**2, 0.0))
            within = aside + math.sqrt(less / math.pi) < 1.05 * radius
            if less < area and within and height < 0.5 * radius and abs(axis @ normal) > 0.9:
                raise InputError(caps.wall_sentence(label, other, scale))


def find_openings(
    vertices: Floats, faces: Integers, label: str, scale: float = 1.0, blunt: bool = False
) -> Ends:
    """Close a surface and find its ends, capped and open.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3), outward.
        label: What messages call the surface.
        scale: Metres per unit of the file, in which messages give places.
        blunt: Whether to look for ends whose rim has been rounded off, and for blind ends.

    Raises:
        InputError: a hole is not the end of a tube, or the surface is that of a wall.
    """
    all_caps = caps.find_caps(vertices, faces, label, scale)
    flat = [
        Candidate(*mesh.region_plane(vertices, faces[c.faces]), c.faces, from_hole=False)
        for c in all_caps
        if c.is_end and c.is_flat
    ]
    uneven = [cap for cap in all_caps if cap.is_end and not cap.is_flat]
    vertices, faces, found = _made_flat(vertices, faces, uneven, flat, label, scale)
    blind = []
    if blunt:
        ends = np.zeros(len(faces), bool)
        for candidate in found:
            ends[candidate.faces] = True
        rounded = []
        for tip in find_tips(vertices, faces):
            if ends[tip.faces].any():
                continue
            cap = caps.blunt_cap(vertices, faces, tip)
            if cap is not None and cap.is_end:
                rounded.append(cap)
            elif cap is None or not any(_same(cap, other) for other in all_caps):
                blind.append(tip)
        if rounded:
            vertices, faces, found = _made_flat(vertices, faces, rounded, found, label, scale)
    found.sort(key=lambda c: (not c.from_hole, -c.area))
    return Ends(vertices, faces, found, [cap for cap in all_caps if not cap.is_end], blind)


def _same(cap: Cap, other: Cap) -> bool:
    """Whether two caps are of one end."""
    return bool(np.linalg.norm(cap.centre - other.centre) < max(cap.radius, other.radius))


def _made_flat(
    vertices: Floats, faces: Integers, uneven: list[Cap], others: list[Candidate], label: str,
    scale: float,
) -> tuple[Floats, Integers, list[Candidate]]:  # fmt: skip
    """Close the holes, and those that caps which are not flat leave when they are taken out."""
    stays = np.ones(len(faces), bool)
    for cap in uneven:
        stays[cap.faces] = False
    number = np.cumsum(stays) - 1
    others = [replace(other, faces=number[other.faces]) for other in others]
    bulges = {int(cap.rim.min()): cap.bulge for cap in uneven}
    vertices, faces, made = _close(vertices, faces[stays], label, scale, bulges)
    if uneven:
        vertices, faces = mesh.drop_unused(vertices, faces)
    return vertices, faces, others + made


def is_round(vertices: Floats, faces: Integers, roundness: float) -> bool:
    """Whether 4 pi area / rim^2 of a flat region reaches a value: a disc 1, a square 0.785."""
    edges, _, uses = mesh.edge_uses(faces)
    rim = vertices[edges[uses == 1]]
    around = float(np.linalg.norm(rim[:, 0] - rim[:, 1], axis=1).sum())
    area = float(np.linalg.norm(mesh.face_vectors(vertices, faces), axis=1).sum())
    return 4 * math.pi * area > roundness * around**2
