"""Blood at the start: a cubic lattice of particles in the lumen behind an opening, and its room.

What belongs to the column is what hangs together with the opening inside the lumen, place by
place: what merely lies beside it, in another branch, does not.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from taichi_sph.errors import InputError
from taichi_sph.geometry import mesh
from taichi_sph.geometry.mesh import Booleans, Floats, Integers, inside_polygon
from taichi_sph.geometry.openings import Opening
from taichi_sph.scene import Column

_TOLERANCE = 1e-3
"""Slack of distances, over the spacing: surfaces are stored in single precision."""
CLEAR = 0.9
"""Blood begins no nearer to a proxy than half a spacing and this part of the setback; calibrated is
the whole of it.  A proxy so near adds 0.08 rho_0 and moves blood at 4 % of the sound speed within a
step; one at 0.4 of it, where a sharp rim presses proxies to, 1.0 rho_0 and at seven times the sound
speed: the run diverges."""
_BLOCKED = 0.05
"""Half-way between two neighbours the wall is farther than this [spacings], or it is between them:
each of them keeps half a spacing."""
_FINER = 0.5
"""Spacing of the lattice that measures a column's room, over the blood's."""
_TOP_LAYERS = 3
"""Where the rim is oblique the first layers may hold no particle."""


class Lumen(Protocol):
    """What filling asks of a vessel."""

    @property
    def vertices(self) -> Floats:
        """(n, 3) [m]."""

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """Lowest and highest corner [m]."""

    @property
    def volume(self) -> float:
        """Volume [m^3]."""

    def contains(self, points: Floats) -> Booleans:
        """Which points (k, 3) lie within."""

    def distance(self, points: Floats) -> Floats:
        """Distance of points (k, 3) to the surface [m]."""


@dataclass(frozen=True, eq=False)
class _Lattice:
    """Places behind an opening."""

    allowed: Booleans
    """Where particles may stand (layers, p, q)."""
    height: Floats
    """Distance of each place from the surface, negative outside; as far as it is worked out, else
    -inf (layers, p, q) [m]."""
    points: Floats
    """Positions (layers, p, q, 3) [m]."""
    depth: Floats
    """Of each layer (layers,) [m]."""
    below_opening: Booleans
    """Places straight below the opening, in the lumen all the way (top layers, p, q)."""
    blocked: tuple[Booleans, ...]
    """Per axis: neighbours (at a place and at the next along it) with a wall between them."""

    def volumes(self, spacing: float) -> Floats:
        """Volume of each layer's places that hang together with the opening [m^3], (layers,).

        A place at the surface counts with the part of its cube that lies within.
        """
        joined = self.joined(len(self.depth))
        beside = ndimage.binary_dilation(joined, np.ones((3, 3, 3))) & ~self.allowed
        within = np.clip(0.5 + self.height / spacing, 0.0, 1.0)
        return np.asarray(spacing**3 * np.where(joined | beside, within, 0.0).sum(axis=(1, 2)))

    def joined(self, layers: int) -> Booleans:
        """The places of the first layers that hang together with the opening through others."""
        allowed = self.allowed[:layers]
        label = self._labels(layers)
        for layer in range(min(_TOP_LAYERS, len(allowed))):
            names = np.unique(label[layer][allowed[layer] & self.below_opening[layer]])
            if len(names):
                return np.asarray(np.isin(label, names))
        return np.zeros_like(allowed)

    def _labels(self, layers: int) -> Integers:
        """Number of the connected part of every place; 0 where none may stand."""
        allowed = self.allowed[:layers]
        if not any(cut[:layers].any() for cut in self.blocked):
            return np.asarray(ndimage.label(allowed)[0])
        number = np.cumsum(allowed).reshape(allowed.shape) - 1
        rows, columns = [], []
        for axis, cut in enumerate(self.blocked):
            here, there = _neighbours(allowed.ndim, axis)
            joined = allowed[here] & allowed[there] & ~cut[:layers][here]
            rows.append(number[here][joined])
            columns.append(number[there][joined])
        i, j = np.concatenate(rows), np.concatenate(columns)
        count = int(allowed.sum())
        graph = coo_matrix((np.ones(len(i)), (i, j)), shape=(count, count))
        label = np.zeros(allowed.shape, np.int64)
        label[allowed] = 1 + connected_components(graph, directed=False)[1]
        return label


def _neighbours(dimensions: int, axis: int) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Slices of all places that have a next one along an axis, and of those next ones."""
    whole = [slice(None)] * dimensions
    here, there = whole.copy(), whole.copy()
    here[axis], there[axis] = slice(None, -1), slice(1, None)
    return tuple(here), tuple(there)


def _lattice(
    lumen: Lumen, opening: Opening, rim: Floats, spacing: float, offset: float, deepest: float,
    clear: float = 0.5,
) -> _Lattice:  # fmt: skip
    """Cubic lattice behind an opening: where particles may stand.

    Args:
        lumen: The closed surface.
        opening: Layers are parallel to its plane.
        rim: Closed polygon round it (n, 3) [m].
        spacing: Of the lattice [m].
        offset: A layer boundary lies this far below the plane [m].
        deepest: Layers go no deeper than this [m].
        clear: Places keep as far from the wall [spacings].
    """
    first, second = mesh.plane_axes(opening.normal)
    apart = lumen.vertices - opening.centre
    lines = []
    for axis in (first, second):
        across, span = apart @ axis, (rim - opening.centre) @ axis
        # An even number of particles across straddles the middle, an odd one stands on it.
        middle = 0.5 * (span.min() + span.max())
        phase = 0.5 * (math.floor(np.ptp(span) / spacing + _TOLERANCE) % 2 == 0)
        low = math.floor((across.min() - middle) / spacing - phase)
        high = math.ceil((across.max() - middle) / spacing - phase)
        lines.append(middle + (np.arange(low, high + 1) + phase) * spacing)
    above = math.ceil(offset / spacing)
    below = math.ceil((deepest - offset) / spacing)
    depth = (offset + (np.arange(-above, below) + 0.5) * spacing).astype(np.float64)
    depth = depth[depth > 0]
    axes = (depth, lines[0], lines[1])
    directions = (-opening.normal, first, second)
    points = _places(axes, directions) + opening.centre
    possible = _coarse(lumen, axes, directions, opening.centre, spacing)
    places = points[possible]
    inside = lumen.contains(places)
    asked = inside if clear > 0.0 else np.ones(len(places), bool)
    away = np.full(len(places), np.inf)
    away[asked] = lumen.distance(places[asked])
    height = np.full(points.shape[:3], -np.inf)
    height[possible] = np.where(inside, away, -away)
    grid = np.zeros(points.shape[:3], bool)
    grid[possible] = inside & (away >= (clear - _TOLERANCE) * spacing)
    top = grid[:_TOP_LAYERS].copy()
    top[top] = _below(lumen, opening, rim, points[:_TOP_LAYERS][top])
    cuts = tuple(_blocked(lumen, grid, points, height, axis, spacing) for axis in range(3))
    return _Lattice(grid, height, points, depth, top, cuts)


def _below(lumen: Lumen, opening: Opening, rim: Floats, places: Floats) -> Booleans:
    """Which places (k, 3) lie straight below an opening, and in the lumen all the way up to it."""
    first, second = mesh.plane_axes(opening.normal)
    axes = np.stack([first, second], axis=1)
    result = inside_polygon((places - opening.centre) @ axes, (rim - opening.centre) @ axes)
    height = (places - opening.centre) @ opening.normal
    for share in (0.25, 0.5, 0.75):
        result[result] = lumen.contains(
            places[result] - share * height[result, None] * opening.normal
        )
    return result


def _blocked(
    lumen: Lumen, grid: Booleans, points: Floats, height: Floats, axis: int, spacing: float
) -> Booleans:
    """Places whose next one along an axis is beyond a wall: two lumens may all but touch."""
    here, there = _neighbours(grid.ndim, axis)
    near = grid[here] & grid[there]
    near &= height[here] + height[there] < (1.0 + 2.0 * _TOLERANCE) * spacing
    middle = 0.5 * (points[here][near] + points[there][near])
    between = lumen.distance(middle) < _BLOCKED * spacing
    between |= ~lumen.contains(middle)
    result = np.zeros_like(grid)
    part = result[here]
    part[near] = between
    return result


def _places(axes: tuple[Floats, ...], directions: tuple[Floats, ...]) -> Floats:
    """Points (a, b, c, 3) of a lattice from coordinates along three directions."""
    a, b, c = (np.multiply.outer(x, d) for x, d in zip(axes, directions, strict=True))
    return a[:, None, None] + b[None, :, None] + c[None, None, :]


def _coarse(
    lumen: Lumen,
    axes: tuple[Floats, ...],
    directions: tuple[Floats, ...],
    centre: Floats,
    spacing: float,
) -> Booleans:
    """Lattice points that may lie within: a box round a bent vessel is mostly empty."""
    block = 6
    middles = tuple(
        np.array([part.mean() for part in np.split(x, range(block, len(x), block))]) for x in axes
    )
    points = _places(middles, directions) + centre
    flat = points.reshape(-1, 3)
    near = lumen.distance(flat) < math.sqrt(3) * 0.5 * block * spacing
    near |= lumen.contains(flat)
    result = near.reshape(points.shape[:3])
    for axis, x in enumerate(axes):
        result = np.repeat(result, block, axis=axis).take(range(len(x)), axis=axis)
    return result


def fill_column(
    lumen: Lumen, opening: Opening, rim: Floats, column: Column, spacing: float
) -> Floats:
    """Blood at the start: a cubic lattice that stands in the lumen behind an opening.

    Every particle is half a spacing or more from the surface and connected to the opening
    through others, inside the lumen; its depth is counted straight down from the opening's plane.

    Args:
        lumen: The closed surface.
        opening: Where the column stands.
        rim: Closed polygon round it (m, 3) [m].
        column: How deep or how many.
        spacing: Distance between particles [m].

    Returns:
        Positions [m], (n, 3), the deepest layer first.

    Raises:
        InputError: the column does not fit.
    """
    reach = float(((opening.centre - lumen.vertices) @ opening.normal).max())
    offset = column.offset
    if offset >= reach:
        raise InputError(
            f"column.offset: {offset:g} m lies below the lumen, which ends {reach:.4g} m "
            f"behind opening {opening.name!r}"
        )
    deepest = reach if column.height is None else min(offset + column.height, reach)
    area = float(np.prod(np.ptp(lumen.vertices, axis=0)) / np.ptp(lumen.vertices, axis=0).min())
    if area * deepest / spacing**3 > 2e8:
        raise InputError(
            f"discretization.spacing: {spacing:g} m is too fine to fill a lumen of "
            f"{lumen.volume * 1e6:.4g} ml"
        )
    if column.particles is not None:
        # A first guess of the depth keeps the lattice small; it grows until enough fit.
        wanted = column.particles
        deepest = min(reach, offset + 1.25 * wanted * spacing**3 / opening.area + 2 * spacing)
        while True:
            found = _shallowest(lumen, opening, rim, spacing, offset, deepest, wanted)
            if found is not None:
                return found
            if deepest >= reach:
                break
            deepest = min(reach, offset + 1.6 * (deepest - offset))
    lattice = _lattice(lumen, opening, rim, spacing, offset, deepest)
    points, depth = lattice.points, lattice.depth
    grid = lattice.joined(len(depth))
    count = int(grid[depth > offset].sum())
    if column.particles is not None:
        raise InputError(
            f"column.particles: {column.particles} do not fit behind opening "
            f"{opening.name!r} at spacing {spacing:g} m; {count} fit"
        )
    if column.height is None:
        if count == 0:
            raise InputError(
                f"column.full: nothing fits behind opening {opening.name!r} at spacing "
                f"{spacing:g} m"
            )
        return points[grid][::-1].copy()
    if column.height < (1.0 - _TOLERANCE) * spacing:
        raise InputError(
            f"column.height: {column.height:g} m is less than one layer of particles at spacing "
            f"{spacing:g} m"
        )
    used = depth[(depth > offset) & grid.any(axis=(1, 2))]
    filled = float(used.max() + 0.5 * spacing - offset) if len(used) else 0.0
    whole = math.floor(column.height / spacing + _TOLERANCE) * spacing
    if filled < whole - 0.5 * spacing or count == 0:
        fits = f"at most {filled:.4g} m" if filled > 0 else "nothing"
        raise InputError(
            f"column.height: {column.height:g} m below an offset of {offset:g} m does not fit "
            f"behind opening {opening.name!r} at spacing {spacing:g} m; {fits} fits"
        )
    lowest = offset + column.height + _TOLERANCE * spacing
    layers = (depth > offset) & (depth + 0.5 * spacing <= lowest)
    return points[layers][grid[layers]][::-1].copy()


def _shallowest(
    lumen: Lumen, opening: Opening, rim: Floats, spacing: float, offset: float, deepest: float,
    wanted: int,
) -> Floats | None:  # fmt: skip
    """The `wanted` connected places of smallest depth (wanted, 3) [m], or None if fewer."""
    lattice = _lattice(lumen, opening, rim, spacing, offset, deepest)
    first = int(np.searchsorted(lattice.depth, offset))
    low, high = first, len(lattice.depth)
    if lattice.joined(high)[first:].sum() < wanted:
        return None
    while low < high:  # least number of layers whose connected part is large enough
        middle = (low + high) // 2
        if lattice.joined(middle)[first:].sum() >= wanted:
            high = middle
        else:
            low = middle + 1
    layer, row, column = np.nonzero(lattice.joined(low)[first:])
    chosen = lattice.points[first:low][layer, row, column]
    # In the last layer the places nearest to its middle stay.
    last = chosen[layer == layer.max()]
    aside = np.linalg.norm(chosen - last.mean(axis=0), axis=1)
    order = np.lexsort((column, row, np.round(aside / spacing, 6), layer))[:wanted]
    return chosen[order][::-1].copy()


@dataclass(frozen=True)
class Room:
    """The part of the lumen that a column takes, up to the wall."""

    volume: float
    """[m^3]"""
    height: float
    """From the column's top to its deepest place [m]."""


def column_room(
    lumen: Lumen, opening: Opening, rim: Floats, column: Column, spacing: float
) -> Room:
    """The part of the lumen that a column of a height, or of a number of particles, takes.

    Its volume is that of the cubes of a lattice, half as wide as the blood's, as far as they lie in
    the lumen.  As many particles take as many spacings cubed of it.

    Args:
        lumen: The closed surface.
        opening: Where the column stands.
        rim: Closed polygon round it (m, 3) [m].
        column: How deep or how many; `fill_column` says whether it fits.
        spacing: Distance between particles [m].
    """
    reach = float(((opening.centre - lumen.vertices) @ opening.normal).max())
    fine, offset = _FINER * spacing, column.offset
    if column.height is not None:
        height = min(column.height, reach - offset)
        fine = height / math.ceil(height / fine)  # whole layers
    else:
        assert column.particles is not None, "a full lumen has the vessel's volume"
        height = 1.25 * column.particles * spacing**3 / opening.area + 2.0 * spacing
    while True:
        height = min(height, reach - offset)
        lattice = _lattice(lumen, opening, rim, fine, offset, offset + height, 0.0)
        filled = np.cumsum(lattice.volumes(fine)[lattice.depth > offset])
        if column.particles is None:
            return Room(float(filled[-1]), height)
        wanted = column.particles * spacing**3
        if filled[-1] >= wanted or height >= reach - offset:
            full = fine * (1.0 + np.arange(len(filled)))
            needed = float(np.interp(wanted, np.append(0.0, filled), np.append(0.0, full)))
            return Room(min(wanted, float(filled[-1])), needed)
        height *= 1.6


def clear_of_proxies(blood: Floats, proxies: Floats, spacing: float, setback: float) -> Booleans:
    """Which blood (n, 3) [m] is as far from all proxies (m, 3) [m] as it can begin, (n,)."""
    if len(blood) == 0 or len(proxies) == 0:
        return np.ones(len(blood), bool)
    least = 0.5 * spacing + CLEAR * setback
    return np.asarray(cKDTree(proxies).query(blood, distance_upper_bound=least)[0] >= least)
