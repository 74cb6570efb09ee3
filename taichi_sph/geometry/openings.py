"""Openings of a lumen surface: its capped ends and its open ones, which are capped here.

An opening is its rim: a cap that is not flat is taken out and made anew, flat, within it.
Mistakes in the file are errors that say what was found and what to change.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from taichi_sph.errors import InputError
from taichi_sph.geometry import caps, mesh
from taichi_sph.geometry.caps import OVAL, STEEP, Cap
from taichi_sph.geometry.mesh import Floats, Integers
from taichi_sph.geometry.surface_file import where
from taichi_sph.geometry.tips import Tip, find_tips

Search = Literal["rims", "tips", "both"]
"""Where ends are looked for."""

FEWEST_EDGES = 6
"""A hole of fewer edges is a triangle or two that are missing, no end of a tube."""
AT_TIP = 0.5
"""An end is a tip's if its cap is no farther from it [radii]: nearly always the tip is on it."""
HALF = 0.5
"""A cap smaller than this is a facet at the end of a branch [radii of the branch]."""
LEVEL = 0.05
"""The rim of a flat end that is at no tip is as flat as this [radii]."""


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
    """Tips of branches that have a rim and are no opening: domes, and what is far from round."""
    blind: list[Tip]
    """Tips of branches that are closed and have no rim.  Both are empty if not looked for."""


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
    vertices: Floats, faces: Integers, holes: list[Candidate], label: str, scale: float = 1.0,
    search: Search = "rims",
) -> Ends:  # fmt: skip
    """Find the ends of a closed surface, and make their caps flat.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3), outward.
        holes: What `close_holes` has closed.
        label: What messages call the surface.
        scale: Metres per unit of the file, in which messages give places.
        search: Where to look: at sharp rims, at the tips of the branches, where ends whose rims
            have been rounded off, oval ones and blind ends are found too, or at both.

    Raises:
        InputError: the surface is that of a wall.
    """
    was_open = np.zeros(len(faces), bool)
    for hole in holes:
        was_open[hole.faces] = True
    found = caps.find_caps(vertices, faces, label, scale)
    found = [cap for cap in found if not was_open[cap.faces].any()]
    ends = [cap for cap in found if cap.is_end]
    doubtful: list[Cap] = []
    blind: list[Tip] = []
    if search != "rims":
        # A piece of wall may be as flat as a small cap; away from tips only what is quite flat
        # counts.
        level = [cap for cap in ends if cap.rim_height < LEVEL and search == "both"]
        ends, doubtful, blind = _at_tips(vertices, faces, holes, found, level)
    flat = [
        Candidate(*mesh.region_plane(vertices, faces[c.faces]), c.faces, from_hole=False)
        for c in ends
        if c.is_flat
    ]
    uneven = [cap for cap in ends if not cap.is_flat]
    vertices, faces, made = _made_flat(vertices, faces, uneven, holes + flat, label, scale)
    made.sort(key=lambda c: (not c.from_hole, -c.area))
    return Ends(vertices, faces, made, doubtful, blind)


def _at_tips(
    vertices: Floats, faces: Integers, holes: list[Candidate], found: list[Cap], chosen: list[Cap]
) -> tuple[list[Cap], list[Cap], list[Tip]]:
    """The caps that are ends, those at tips that are none, and the blind tips.

    `found` are all caps with a rim, `chosen` those that are ends wherever they are.
    """
    doubtful, blind = [], []
    for tip in find_tips(vertices, faces):
        if tip.radius == 0.0:
            continue
        away = np.linalg.norm(vertices[faces] - tip.place, axis=2).min(axis=1)
        if any(away[hole.faces].min() < AT_TIP * hole.radius for hole in holes):
            continue
        there = [
            cap
            for cap in found
            if cap.radius > HALF * tip.radius and away[cap.faces].min() < AT_TIP * cap.radius
        ]
        # Beside a true end a coarse or stepped wall has flats of its own.
        there.sort(key=lambda cap: (not cap.is_end, abs(math.log(cap.radius / tip.radius))))
        blunt = caps.blunt_cap(vertices, faces, tip)
        if blunt is not None and not HALF < blunt.radius / tip.radius < 1.5:
            blunt = None
        # A branch that ends so ends there, round or not.
        cut = [
            cap
            for cap in [*there, *([blunt] if blunt is not None else [])]
            if cap.bulge <= caps.BULGE and cap.roundness >= OVAL
        ]
        if cut:
            chosen = [c for c in chosen if not np.isin(c.faces, cut[0].faces).any()] + cut[:1]
        elif there:
            doubtful.append(there[0])
        else:
            blind.append(tip)
    return chosen, doubtful, blind


def _made_flat(
    vertices: Floats, faces: Integers, uneven: list[Cap], others: list[Candidate], label: str,
    scale: float,
) -> tuple[Floats, Integers, list[Candidate]]:  # fmt: skip
    """Take out the caps that are not flat and close the holes that they leave."""
    if not uneven:
        return vertices, faces, list(others)
    stays = np.ones(len(faces), bool)
    for cap in uneven:
        stays[cap.faces] = False
    number = np.cumsum(stays) - 1
    others = [replace(other, faces=number[other.faces]) for other in others]
    bulges = {int(cap.rim.min()): cap.bulge for cap in uneven}
    vertices, faces, made = _close(vertices, faces[stays], label, scale, bulges)
    return *mesh.drop_unused(vertices, faces), others + made


def is_round(vertices: Floats, faces: Integers, roundness: float) -> bool:
    """Whether 4 pi area / rim^2 of a flat region reaches a value: a disc 1, a square 0.785."""
    edges, _, uses = mesh.edge_uses(faces)
    rim = vertices[edges[uses == 1]]
    around = float(np.linalg.norm(rim[:, 0] - rim[:, 1], axis=1).sum())
    area = float(np.linalg.norm(mesh.face_vectors(vertices, faces), axis=1).sum())
    return 4 * math.pi * area > roundness * around**2
