"""Caps: the ends of a closed lumen, found by their rims, and its blind ends.

A cap is what lies within a sharp convex rim that is round and nearly flat.  It need not be flat
itself: caps are fanned from a displaced middle, smoothed, or meshed anew with the wall.
"""

import math
from dataclasses import dataclass

import igl
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from taichi_sph.errors import InputError
from taichi_sph.geometry import mesh
from taichi_sph.geometry.mesh import Booleans, Floats, Integers
from taichi_sph.geometry.surface_file import where
from taichi_sph.geometry.tips import Tip

ANGLES = (0.5, 3.0, 12.0, 25.0)
"""Neighbours within a cap turn by less [degrees]; several are tried, for a cap may be uneven and a
wall flat."""
SHARP = 30.0
"""A rim turns by more [degrees]: a cut at 60 degrees to the axis still does."""
FLAT = 1e-3
"""A cap whose vertices all lie so near to its rim's plane [radii] stays as it is."""
BULGE = 0.2
"""A cap that stands farther off its rim's plane [radii] is a dome, no cut through a vessel.  A ball
of which 45 degrees are seen stands off by 0.41, an oblate one of 1:4 by this."""
ROUND, OVAL = 0.6, 0.4
"""4 pi area / rim^2 that an end reaches: a disc 1, a square 0.785, a strip of 1:2 0.70.  A flat end
between the two is named and not taken; a hole there is one that was cut on purpose."""
SHELL = 0.01
"""A piece of a smaller share of the area is a crumb."""
STEEP = 0.75
"""Mean |cosine| between the wall at a rim and the end's normal; at a cut of 60 degrees 0.55."""


@dataclass(frozen=True, eq=False)
class Cap:
    """An end of a closed surface."""

    faces: Integers
    """Its triangles."""
    rim: Integers
    """Vertices round it, right-handed about the normal."""
    centre: Floats
    """Middle of the rim's area, (3,)."""
    normal: Floats
    """Out of the lumen, (3,)."""
    radius: float
    """Of the circle of the rim's area."""
    bulge: float
    """How far the cap stands off the rim's plane [radii]."""
    rim_height: float
    """From the lowest to the highest place of the rim, along the normal [radii]."""
    roundness: float
    """4 pi area / rim^2."""

    @property
    def is_flat(self) -> bool:
        """Whether the cap can stay as it is."""
        return self.bulge <= FLAT

    @property
    def what_is_wrong(self) -> str:
        """Why it is no cut through a vessel; empty where it is one."""
        if self.bulge > BULGE:
            return f"it bulges by {100 * self.bulge:.0f} % of its radius; at most {100 * BULGE:.0f}"
        if self.roundness < ROUND:
            return f"its rim is not round: 4 pi area / rim^2 is {self.roundness:.2f}"
        return ""

    @property
    def is_end(self) -> bool:
        """Whether it is a cut through a vessel."""
        return self.bulge <= BULGE and self.roundness >= ROUND


class _Skin:
    """What is asked again and again of a closed surface: its edges, normals and areas."""

    def __init__(self, vertices: Floats, faces: Integers):
        self.vertices, self.faces = vertices, faces
        self.vectors = mesh.face_vectors(vertices, faces)
        self.normals = mesh.unit(self.vectors)
        self.areas = np.linalg.norm(self.vectors, axis=1)
        self.middles = vertices[faces].mean(axis=1)
        self.pairs, self.edges = mesh.face_pairs(faces)
        first, second = self.pairs.T
        self.cosine = np.einsum("ij,ij->i", self.normals[first], self.normals[second])
        self.length = np.linalg.norm(
            vertices[self.edges[:, 0]] - vertices[self.edges[:, 1]], axis=1
        )
        apart = self.middles[second] - self.middles[first]
        self.convex = np.einsum("ij,ij->i", apart, self.normals[first]) < 0.0

    def patches(self, angle: float) -> tuple[int, Integers]:
        """Number of parts that turn by less than an angle [degrees], and the faces'."""
        smooth = self.cosine > math.cos(math.radians(angle))
        return self.joined(smooth)

    def joined(self, edges: Booleans) -> tuple[int, Integers]:
        """Number of parts joined by some of the edges, and the part of each triangle."""
        pairs = self.pairs[edges]
        n = len(self.faces)
        graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
        count, label = connected_components(graph, directed=False)
        return int(count), np.asarray(label, np.int64)

    def beyond(self, members: Integers, loop: Integers) -> Integers:
        """Triangles on the other side of a patch's rim, one for each edge of the loop, (k,)."""
        own = np.zeros(len(self.faces), bool)
        own[members] = True
        on_rim = np.zeros(len(self.vertices), bool)
        on_rim[loop] = True
        first, second = self.pairs.T
        border = (own[first] != own[second]) & on_rim[self.edges].all(axis=1)
        return np.where(own[first[border]], second[border], first[border])

    def falls_away(self, cap: "Cap") -> bool:
        """Whether the wall beyond a rim goes down from the cap's plane, for a radius too.

        A facet of a coarse or noisy wall has its like around it.
        """
        beyond = self.beyond(cap.faces, cap.rim)
        if np.abs(self.normals[beyond] @ cap.normal).mean() > STEEP:
            return False
        near = np.linalg.norm(self.middles - cap.centre, axis=1) < 2.0 * cap.radius
        near[beyond] = True
        near[cap.faces] = False
        _, part = self.joined(np.all(near[self.pairs], axis=1))
        around = near & np.isin(part, part[beyond])
        level = np.abs(self.normals[around] @ cap.normal)
        return bool(np.average(level, weights=self.areas[around]) <= STEEP)

    def filled(self, members: Integers) -> Integers:
        """A patch with what it encloses: all but the largest part of the rest."""
        own = np.zeros(len(self.faces), bool)
        own[members] = True
        first, second = self.pairs.T
        _, label = self.joined(own[first] == own[second])
        size = np.bincount(label, self.areas * ~own)
        return np.flatnonzero(own | (label != size.argmax()))


def _cap(skin: _Skin, members: Integers, loop: Integers) -> Cap:
    rim = skin.vertices[loop]
    centre, normal, area = mesh.loop_plane(rim)
    around = float(np.linalg.norm(np.roll(rim, -1, axis=0) - rim, axis=1).sum())
    radius = math.sqrt(area / math.pi)
    height = (skin.vertices[np.unique(skin.faces[members])] - centre) @ normal
    bulge = float(np.abs(height).max()) / max(radius, 1e-300)
    uneven = float(np.ptp((rim - centre) @ normal)) / max(radius, 1e-300)
    roundness = 4 * math.pi * area / around**2
    return Cap(members, loop, centre, normal, radius, bulge, uneven, roundness)


def _loops(faces: Integers) -> list[Integers]:
    """Rims of a patch, the longest first; none where it touches itself."""
    try:
        return sorted(mesh.boundary_loops(faces), key=len, reverse=True)
    except ValueError:
        return []


def _refuse_ring(
    skin: _Skin, members: Integers, loops: list[Integers], label: str, scale: float
) -> None:
    """Refuse a flat end with a hole into which the surface goes on: the solid of a wall.

    Raises:
        InputError: it is one.
    """
    normal = mesh.unit(skin.vectors[members].sum(axis=0))
    for loop in loops[1:]:
        middle = skin.vertices[loop].mean(axis=0)
        inner = skin.beyond(members, loop)
        if len(inner) < len(loop):  # open there
            continue
        apart = skin.middles[inner] - middle
        height = apart @ normal
        aside = mesh.unit(apart - height[:, None] * normal)
        turned = np.einsum("ij,ij->i", skin.normals[inner], aside)
        # The bore's skin goes down from the rim and faces its axis.
        if (height < 0.0).mean() > 0.9 and np.median(turned) < -0.5:
            raise InputError(wall_sentence(label, middle, scale))


def wall_sentence(label: str, place: Floats, scale: float) -> str:
    """What is said of a surface that is the wall's and not the lumen's."""
    return (
        f"{label}: the flat end at {where(place / scale)} in units of the file has a hole in it: "
        "this is a wall, not a lumen; give the inner surface"
    )


def refuse_shells(vertices: Floats, faces: Integers, label: str, scale: float = 1.0) -> None:
    """Refuse two skins of which one lies in the other: the inside and the outside of a wall.

    Args:
        vertices: (n, 3).
        faces: (m, 3), of any number of pieces, open or closed.
        label: What messages call the surface.
        scale: Of the vertices, over the units of the file, in which places are said.

    Raises:
        InputError: there are two such.
    """
    count, piece = mesh.components(faces) if len(faces) else (0, np.zeros(0, np.int64))
    if count < 2:
        return
    areas = np.linalg.norm(mesh.face_vectors(vertices, faces), axis=1)
    size = np.bincount(piece, areas)
    outer = int(size.argmax())
    tree = igl.FastWindingNumberBVH()
    tree.init(*mesh.drop_unused(vertices, np.ascontiguousarray(faces[piece == outer], np.int64)))
    for inner in np.flatnonzero(size > SHELL * size.sum()):
        points = np.ascontiguousarray(vertices[np.unique(faces[piece == inner])])
        within = np.abs(np.asarray(tree.winding_number(points)).reshape(-1)) > 0.5
        if inner != outer and within.mean() > 0.5:
            raise InputError(
                f"{label}: a surface lies within another (at {where(points.mean(axis=0) / scale)} "
                "in units of the file): this is a wall, not a lumen; give the inner surface"
            )


def find_caps(vertices: Floats, faces: Integers, label: str, scale: float = 1.0) -> list[Cap]:
    """Parts of a surface within a sharp, convex, nearly flat rim, the largest first.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3), outward.
        label: What messages call the surface.
        scale: Metres per unit of the file, in which messages give places.

    Raises:
        InputError: one has a hole in it, so that the surface is that of a wall.
    """
    skin = _Skin(vertices, faces)
    found: list[Cap] = []
    sharp = skin.cosine < math.cos(math.radians(SHARP))
    for angle in ANGLES:
        count, part = skin.patches(angle)
        area = np.bincount(part, skin.areas, count)
        border = part[skin.pairs[:, 0]] != part[skin.pairs[:, 1]]
        rim, hard = (
            sum(np.bincount(part[skin.pairs[rows, k]], skin.length[rows], count) for k in (0, 1))
            for rows in (border, border & sharp & skin.convex)
        )
        along = np.stack([np.bincount(part, skin.vectors[:, k], count) for k in range(3)], axis=1)
        # A dome's normals still point one way on the whole, those all round a tube do not.
        one_way = np.linalg.norm(along, axis=1) > 0.6 * area
        order = np.argsort(part, kind="stable")
        start = np.searchsorted(part[order], np.arange(count + 1))
        for name in np.flatnonzero((hard > 0.9 * rim) & (rim > 0) & one_way):
            members = np.sort(order[start[name] : start[name + 1]])
            loops = _loops(faces[members])
            if len(loops) > 1:
                _refuse_ring(skin, members, loops, label, scale)
                members = skin.filled(members)
                loops = _loops(faces[members])
            if len(loops) != 1 or len(loops[0]) < 4:
                continue
            cap = _cap(skin, members, loops[0])
            disc = cap.radius > 0 and cap.roundness >= OVAL and cap.rim_height <= 0.5
            if disc and skin.falls_away(cap):
                found.append(cap)
    taken = np.zeros(len(faces), bool)
    caps = []
    for cap in sorted(found, key=lambda c: (not c.is_end, -c.radius, int(c.faces[0]))):
        if not taken[cap.faces].any():
            taken[cap.faces] = True
            caps.append(cap)
    return caps


def flat_part_at(vertices: Floats, faces: Integers, point: Floats) -> Integers:
    """Triangles of the plane part of a surface nearest to a point (3,); none if it is no disc.

    A cap that has been made flat is one, though its rim may be too blunt to be found.
    """
    extent = float(np.ptp(vertices, axis=0).max())
    _, nearest, place = mesh.NearestPoint(vertices, faces)(point[None])
    skin = _Skin(vertices, faces)
    normal = skin.normals[nearest[0]]
    # Ten times the grain of single precision.
    level = np.abs((vertices - place[0]) @ normal) < 1e-6 * extent
    flat: Booleans = np.all(level[faces], axis=1) & (skin.normals @ normal > 0.999)
    _, part = skin.joined(np.all(flat[skin.pairs], axis=1))
    members = np.flatnonzero(part == part[nearest[0]])
    loops = _loops(faces[members])
    if len(loops) != 1 or len(loops[0]) < 4:
        return np.zeros(0, np.int64)
    cap = _cap(skin, members, loops[0])
    return members if cap.roundness >= OVAL else np.zeros(0, np.int64)


def blunt_cap(vertices: Floats, faces: Integers, tip: Tip) -> Cap | None:
    """The cap at the end of a branch whose rim has been rounded off; None where it has no disc.

    Its rim is where the surface has turned half-way from the axis to the wall.
    """
    skin = _Skin(vertices, faces)
    near = np.zeros(len(faces), bool)
    near[tip.faces] = True
    axis = tip.axis
    for _ in range(3):
        ahead = near & (skin.normals @ axis > math.cos(math.radians(45.0)))
        if not ahead.any():
            return None
        _, part = skin.joined(np.all(ahead[skin.pairs], axis=1))
        largest = np.bincount(part, skin.areas * ahead).argmax()
        members = np.flatnonzero(ahead & (part == largest))
        axis = mesh.unit(skin.vectors[members].sum(axis=0))
    members = skin.filled(members)
    loops = _loops(faces[members])
    if len(loops) != 1 or len(loops[0]) < 4:
        return None
    return _cap(skin, members, loops[0])
