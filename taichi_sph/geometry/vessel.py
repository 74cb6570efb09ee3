"""Vessel: the lumen as a closed surface with openings, and what is asked of it.

The surface is where blood ends.  A file may bring it closed, with flat caps, or open, as a tube;
open ends are capped here.  Mistakes in the file are errors that say what to change.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_sph.errors import InputError
from taichi_sph.geometry import clearance, filling, mesh, wall_sampling
from taichi_sph.geometry.caps import flat_part_at, refuse_shells
from taichi_sph.geometry.closed_surface import ClosedSurface
from taichi_sph.geometry.gaps import gaps_at
from taichi_sph.geometry.interior import Interior
from taichi_sph.geometry.mending import mend
from taichi_sph.geometry.mesh import Booleans, Floats, Integers
from taichi_sph.geometry.openings import (
    Candidate,
    Ends,
    Opening,
    close_holes,
    find_openings,
    is_round,
)
from taichi_sph.geometry.surface_file import (
    load_surface,
    require_manifold,
    require_outward,
    where,
)
from taichi_sph.geometry.wall_sampling import WallSample
from taichi_sph.scene import Column, OpeningTable, Scene

LARGEST = 2.0
"""A larger surface was given in other units than it claims [m]."""
SMALLEST = 1e-3
"""And a smaller one [m]."""
_GRAIN = 0.05
"""What lies beyond an opening is looked for so finely [radii of the opening] ..."""
_MOST_SAMPLES = 100_000
"""... and by no more points."""
GAP = 3.0
"""Wider gaps between parts of the lumen side by side are nobody's concern [setbacks]: beyond 2.6 of
them blood's first layer feels no proxy of the other part, at a support radius of 2 spacings."""
LEAST_ACROSS = 4.0
"""Particles across the narrowest place below which nothing can be resolved."""


@dataclass(frozen=True, eq=False)
class Vessel:
    """A closed lumen surface with outward normals, in metres."""

    vertices: Floats
    """(n, 3) [m]."""
    faces: NDArray[np.int32]
    """Triangles, outward by the right-hand rule, (m, 3)."""
    face_opening: NDArray[np.int32]
    """Opening that a triangle caps, as an index into `openings`; -1 is wall.  (m,)."""
    openings: tuple[Opening, ...]
    """The openings that the scene names, in its order."""
    unnamed: tuple[Opening, ...] = ()
    """Openings of the surface that the scene does not name: capped."""
    label: str = "surface"
    """What messages call it: the file's path."""
    notes: tuple[str, ...] = ()
    """What was mended in the file."""

    @cached_property
    def _triangles(self) -> Integers:
        return np.ascontiguousarray(self.faces, np.int64)

    @cached_property
    def _surface(self) -> ClosedSurface:
        return ClosedSurface(self.vertices, self._triangles)

    @cached_property
    def _interior(self) -> Interior:
        return Interior(*self.bounds, self.volume, self.signed_distance)

    @cached_property
    def _clear(self) -> dict[tuple[int, float, float], float]:
        """What `clear_beyond` has found."""
        return {}

    @cached_property
    def wall_faces(self) -> Integers:
        """Triangles that carry proxies (w, 3): all but the caps of open openings."""
        is_open = np.array([opening.is_open for opening in self.openings] + [False])
        return self._triangles[~is_open[self.face_opening]]

    @cached_property
    def wall_vertices(self) -> Integers:
        """Vertices that the wall's triangles have, by number, (k,)."""
        return np.unique(self.wall_faces)

    @cached_property
    def wall_normals(self) -> Floats:
        """Unit normals out of the lumen at `wall_vertices`, (k, 3)."""
        normals = np.zeros((len(self.vertices), 3))
        vectors = mesh.face_vectors(self.vertices, self.wall_faces)
        for corner in range(3):
            np.add.at(normals, self.wall_faces[:, corner], vectors)
        return mesh.unit(normals[self.wall_vertices])

    @cached_property
    def volume(self) -> float:
        """Volume of the lumen [m^3]."""
        return mesh.enclosed_volume(self.vertices, self._triangles)

    @cached_property
    def wall_area(self) -> float:
        """Area of the triangles that carry proxies [m^2]."""
        return float(
            np.linalg.norm(mesh.face_vectors(self.vertices, self.wall_faces), axis=1).sum()
        )

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """Lowest and highest corner of the bounding box [m]."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)

    def opening(self, name: str) -> Opening:
        """The opening of that name.

        Raises:
            InputError: there is none.
        """
        for opening in self.openings:
            if opening.name == name:
                return opening
        allowed = ", ".join(opening.name for opening in self.openings) or "none"
        raise InputError(f"column.opening: {name!r} is not an opening; allowed: {allowed}")

    def contains(self, points: Floats) -> Booleans:
        """Which points (k, 3) [m] lie within the lumen."""
        return self._surface.contains(points)

    def distance(self, points: Floats) -> Floats:
        """Distance of points (k, 3) to the closed surface [m], (k,)."""
        return self._surface.distance(points)

    def nearest_wall(self, points: Floats) -> tuple[Floats, Integers, Floats, Floats]:
        """Places on the surface nearest to points (k, 3) [m].

        Returns:
            distances [m] (k,), triangles (k,), places [m] (k, 3), unit normals outward (k, 3).
        """
        away, triangle, places = self._surface.nearest(points)
        normals = wall_sampling.normals_at(self.vertices, self._triangles, places, triangle)
        return away, triangle, places, normals

    def rim(self, number: int) -> Floats:
        """Closed polygon round opening `number` [m], (n, 3)."""
        loops = mesh.boundary_loops(self._triangles[self.face_opening == number])
        longest = max(loops, key=len)
        return self.vertices[longest]

    def clear_beyond(self, number: int, radii: float, shift: float = 0.0) -> float:
        """How far from its middle, beyond opening `number`'s plane, nothing of the lumen lies [m].

        At most so many of its radii: another branch may pass by there, whose blood has not left.

        Args:
            number: Of the opening.
            radii: The most that is looked at [radii of the opening].
            shift: The plane is taken so far beyond the opening's [m].

        Raises:
            InputError: the lumen lies right beyond the opening.
        """
        key = (number, radii, shift)
        if key not in self._clear:
            self._clear[key] = self._find_clear(*key)
        return self._clear[key]

    def _find_clear(self, number: int, radii: float, shift: float) -> float:
        opening = self.openings[number]
        corners = self.vertices[self._triangles]
        middles = corners.mean(axis=1)
        size = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)
        most = radii * opening.radius
        plane = opening.centre + shift * opening.normal
        apart = middles - plane
        near = (np.linalg.norm(apart, axis=1) < most + size) & (apart @ opening.normal > -size)
        faces = self._triangles[near & (self.face_opening != number)]
        area = float(np.linalg.norm(mesh.face_vectors(self.vertices, faces), axis=1).sum())
        count = min(_MOST_SAMPLES, int(area / (_GRAIN * opening.radius) ** 2) + 1)
        if area == 0.0:
            return most
        grain = max(_GRAIN * opening.radius, math.sqrt(area / count))
        apart = wall_sampling.stratified_points(self.vertices, faces, count, seed=0) - plane
        beyond = apart[apart @ opening.normal > grain]
        closest = float(np.linalg.norm(beyond, axis=1).min(initial=np.inf)) - grain
        if closest >= most:
            return most
        rim = float(np.linalg.norm(self.rim(number) - opening.centre, axis=1).max())
        if closest < 0.9 * rim:
            raise InputError(
                f"openings.{opening.name}: another part of the lumen of {self.label} lies right "
                f"beyond it, {1e3 * max(closest, 0.0):.3g} mm from its middle, so that blood "
                "cannot leave; cut that end farther back, or set its state to capped"
            )
        return max(closest, rim)

    def signed_distance(self, points: Floats) -> Floats:
        """Distance of points (k, 3) to the closed surface [m], negative within the lumen, (k,)."""
        return self._surface.signed_distance(points)

    def count_leaks(self, points: Floats, tolerance: float = 0.0) -> int:
        """Points (k, 3) that have left the lumen other than through an open opening.

        Args:
            points: Positions [m].
            tolerance: A point this close to the surface counts as within [m].
        """
        points = np.asarray(points, np.float64)
        points = points[~self._interior.holds(points)]
        outside = points[~self.contains(points)]
        for number, opening in enumerate(self.openings):
            if opening.is_open:
                apart = outside - opening.centre
                left = (apart @ opening.normal > -tolerance) & (
                    np.linalg.norm(apart, axis=1) < self.clear_beyond(number, 3.0)
                )
                outside = outside[~left]
        if tolerance > 0.0:
            outside = outside[self.distance(outside) > tolerance]
        return len(outside)

    def sample_wall(self, spacing: float, setback: float, seed: int = 0) -> WallSample:
        """Spread proxies evenly over the wall and set them back out of the lumen.

        The points are even on the lumen's surface and then moved along its outward normal; those
        that this brings nearer to the lumen than 0.4 of the setback (in the crotch of a
        bifurcation) are dropped.  Between parts of the lumen that lie side by side none goes
        farther than half-way: dropped, they would leave a hole from one into the other.  At an
        open end none stands beyond the opening's plane.

        Args:
            spacing: Distance between proxies [m]; wall area / spacing^2 of them are made.
            setback: Distance from the lumen's surface [m].
            seed: Of the random start; the same seed gives the same points to the last bit.
        """
        faces = self.wall_faces
        ends = [value for o in self.openings if o.is_open for value in (*o.centre, *o.normal)]
        key = wall_sampling.cache_key(self.vertices, faces, spacing, setback, seed, *ends)
        stored = wall_sampling.load_cached(key)
        if stored is not None:
            return stored
        mesh.log_stage("spreading proxies over the wall", len(faces))
        points, nearest = wall_sampling.relaxed_points(self.vertices, faces, spacing, seed)
        figures = wall_sampling.spacing_statistics(points, self.vertices, faces, spacing)
        normals = wall_sampling.normals_at(self.vertices, faces, points, nearest)
        # Where proxies are denser than blood the pairs are made fewer by the coarser length.
        length, widest = max(spacing, setback), GAP * setback
        gaps = gaps_at(self._surface, faces, points, nearest, normals, length, widest)
        positions = points + np.minimum(setback, 0.5 * gaps)[:, None] * normals
        for opening in self.openings:
            if opening.is_open:
                apart = positions - opening.centre
                beyond = np.maximum(apart @ opening.normal, 0.0)
                beyond[np.linalg.norm(points - opening.centre, axis=1) > 3.0 * opening.radius] = 0.0
                positions -= beyond[:, None] * opening.normal
        kept = gaps < 2.0 * setback
        kept |= setback <= 0
        kept[~kept] = self.signed_distance(positions[~kept]) > 0.4 * setback
        x, y, z = points[gaps.argmin()].tolist() if len(points) else (0.0, 0.0, 0.0)
        sample = WallSample(
            positions[kept], normals[kept], *figures, int((~kept).sum()),
            float(gaps.min(initial=np.inf)), (x, y, z),
        )  # fmt: skip
        wall_sampling.store_cached(key, sample)
        return sample

    def fill_column(self, column: Column, spacing: float) -> Floats:
        """Positions of the blood at the start [m], (n, 3): see `filling.fill_column`.

        Raises:
            InputError: the column does not fit, or its opening is not there.
        """
        opening = self.opening(column.opening)
        rim = self.rim(self.openings.index(opening))
        return filling.fill_column(self, opening, rim, column, spacing)

    def column_room(self, column: Column, spacing: float) -> filling.Room:
        """The part of the lumen that a column takes: see `filling.column_room`.

        Raises:
            InputError: its opening is not there.
        """
        if column.full:
            return filling.Room(self.volume, math.inf)
        opening = self.opening(column.opening)
        rim = self.rim(self.openings.index(opening))
        return filling.column_room(self, opening, rim, column, spacing)

    @cached_property
    def _narrowest_place(self) -> tuple[float, int]:
        mesh.log_stage("finding the narrowest place", len(self.faces))
        ends = [(o.centre, o.normal, o.radius) for o in self.openings if o.is_open]
        return clearance.narrowest_place(
            self.vertices, self._triangles, self.wall_faces, ends, self.contains
        )

    @property
    def narrowest(self) -> float:
        """Diameter of the largest ball that passes between the open openings [m].

        Blind side branches do not count.  With no opening open: of the largest ball that fits.
        """
        return 2.0 * self._narrowest_place[0]

    @property
    def narrowest_opening(self) -> Opening | None:
        """The open opening that the narrowest place is in or on the way to; None without one."""
        ends = [o for o in self.openings if o.is_open]
        return ends[self._narrowest_place[1]] if ends else None

    def require_resolution(self, spacing: float) -> None:
        """Refuse a spacing too coarse for the lumen.

        Raises:
            InputError: fewer than `LEAST_ACROSS` particles fit across the narrowest place.
        """
        across = self.narrowest / spacing
        most = 0.998 * self.narrowest / LEAST_ACROSS
        if across < LEAST_ACROSS:
            opening = self.narrowest_opening
            there = f" at opening {opening.name!r}" if opening is not None else ""
            raise InputError(
                f"discretization.spacing: {spacing:g} m puts {across:.1f} particles across the "
                f"narrowest place of {self.label} ({self.narrowest:.3g} m{there}); at least "
                f"{LEAST_ACROSS:g} are needed: at most {most:.3g} m"
            )


def build_vessel(
    vertices: Floats, faces: Integers, openings: dict[str, OpeningTable], scale: float, label: str
) -> Vessel:
    """Make a vessel of a mesh in metres.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3), outward.
        openings: The scene's; their centres are in units of the file.
        scale: Metres per unit of the file.
        label: What messages call the surface.

    Raises:
        InputError: the surface cannot hold blood, or an opening is not on it.
    """
    extent = float(np.ptp(vertices, axis=0).max()) if len(vertices) else 0.0
    if extent > LARGEST or extent < SMALLEST:
        guess = scale * 1e-3 if extent > LARGEST else scale * 1e3
        kind = (
            "millimetres taken for metres" if extent > LARGEST else "metres taken for millimetres"
        )
        raise InputError(
            f"{label}: {extent:.4g} m across at vessel.scale = {scale:g}, no vessel is; allowed: "
            f"{SMALLEST:g} to {LARGEST:g} m; if these are {kind}, set vessel.scale = {guess:g}"
        )
    vertices, faces, notes = mend(vertices, faces, label)
    refuse_shells(vertices, faces, label, scale)
    require_manifold(vertices, faces, label, scale)
    mesh.log_stage("finding openings", len(faces))
    vertices, faces, holes = close_holes(vertices, faces, label, scale)
    require_outward(vertices, faces, label)
    ends = find_openings(vertices, faces, holes, label, scale)
    if any(not _near(ends, np.array(table.centre) * scale) for table in openings.values()):
        ends = find_openings(vertices, faces, holes, label, scale, "both")
    vertices, faces = ends.vertices, ends.faces
    matched = _match(openings, ends, scale, label)
    face_opening = np.full(len(faces), -1, np.int32)
    named = []
    for index, (name, candidate) in enumerate(matched.items()):
        face_opening[candidate.faces] = index
        named.append(_opening(name, candidate, openings[name].state == "open"))
    others = [c for c in ends.found if all(c is not chosen for chosen in matched.values())]
    # Any flat wall looks like a cap; those listed as unnamed are rounder than a square.
    round_ones = [c for c in others if c.from_hole or is_round(vertices, faces[c.faces], 0.82)]
    unnamed = [_opening(f"unnamed_{k}", c, False) for k, c in enumerate(round_ones, 1)]
    return Vessel(
        vertices, faces.astype(np.int32), face_opening, tuple(named), tuple(unnamed), label,
        tuple(notes),
    )  # fmt: skip


def _opening(name: str, found: Candidate, is_open: bool) -> Opening:
    return Opening(name, found.centre, found.normal, found.radius, found.area, is_open)


def _match(
    openings: dict[str, OpeningTable], ends: Ends, scale: float, label: str
) -> dict[str, Candidate]:
    """The end that each of the scene's openings means.

    Raises:
        InputError: none is near, or two names mean the same.
    """
    matched: dict[str, Candidate] = {}
    for name, table in openings.items():
        point = np.array(table.centre) * scale
        near = _near(ends, point) or _flat_there(ends, point)
        if not near:
            raise InputError(
                f"openings.{name}: no opening of {label} is at {where(np.array(table.centre))}; "
                + _what_is_there(ends, point, scale)
            )
        chosen = min(near, key=lambda c: float(np.linalg.norm(c.centre - point)))
        for other, taken in matched.items():
            if taken is chosen or np.isin(chosen.faces, taken.faces).any():
                raise InputError(
                    f"openings.{name}: the same opening of {label} as openings.{other}; "
                    "each name needs its own"
                )
        matched[name] = chosen
    return matched


def _near(ends: Ends, point: Floats) -> list[Candidate]:
    """Ends that a scene's point (3,) may mean."""
    return [c for c in ends.found if np.linalg.norm(c.centre - point) < c.radius]


def _flat_there(ends: Ends, point: Floats) -> list[Candidate]:
    """The flat disc that a scene points at, though its rim is too blunt to be found."""
    members = flat_part_at(ends.vertices, ends.faces, point)
    if len(members) == 0:
        return []
    plane = mesh.region_plane(ends.vertices, ends.faces[members])
    disc = Candidate(*plane, members, from_hole=False)
    return [disc] if np.linalg.norm(disc.centre - point) < 0.5 * disc.radius else []


def _what_is_there(ends: Ends, point: Floats, scale: float) -> str:
    """What a scene's opening that was not found may have meant."""
    for cap in ends.doubtful:
        if np.linalg.norm(cap.centre - point) < cap.radius:
            return f"the end there is none: {cap.what_is_wrong}; cut it flat or leave it open"
    places = "; ".join(where(c.centre / scale) for c in ends.found[:8]) or "none"
    return f"found, in units of the file: {places}"


def read_vessel(scene: Scene) -> Vessel:
    """Read, check and close the surface of a scene.

    Raises:
        InputError: the surface cannot hold blood, an opening is not on it, or the spacing is too
            coarse for it.
    """
    path = Path(scene.folder) / scene.vessel.surface
    vertices, faces = load_surface(path)
    vessel = build_vessel(
        vertices * scene.vessel.scale, faces, scene.openings, scene.vessel.scale, str(path)
    )
    vessel.opening(scene.column.opening)
    vessel.require_resolution(scene.discretization.spacing)
    return vessel
