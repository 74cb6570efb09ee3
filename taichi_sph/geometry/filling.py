"""Blood at the start: a cubic lattice of particles in the lumen behind an opening."""

import math
from typing import Protocol

import numpy as np
from scipy import ndimage

from taichi_sph.errors import InputError
from taichi_sph.geometry import mesh
from taichi_sph.geometry.mesh import Booleans, Floats
from taichi_sph.geometry.openings import Opening
from taichi_sph.scene import Column

_TOLERANCE = 1e-3
"""Slack of distances, over the spacing: surfaces are stored in single precision."""


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


def _lattice(
    lumen: Lumen, opening: Opening, spacing: float, offset: float, deepest: float
) -> tuple[Booleans, Floats, Floats]:
    """Cubic lattice behind an opening: where particles may stand.

    Args:
        lumen: The closed surface.
        opening: Layers are parallel to its plane.
        spacing: Of the lattice [m].
        offset: A layer boundary lies this far below the plane [m].
        deepest: Layers go no deeper than this [m].

    Returns:
        Grid (layers, p, q) of allowed places, their positions (layers, p, q, 3) [m], and the
        depth of each layer (layers,) [m].
    """
    first, second = mesh.plane_axes(opening.normal)
    apart = lumen.vertices - opening.centre
    lines = []
    rim = apart[np.abs(apart @ opening.normal) < 1e-3 * opening.radius]
    rim = rim[np.linalg.norm(rim, axis=1) < 3.0 * opening.radius]
    for axis in (first, second):
        across, span = apart @ axis, rim @ axis
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
    allowed = lumen.contains(places)
    allowed[allowed] = lumen.distance(places[allowed]) >= (0.5 - _TOLERANCE) * spacing
    grid = np.zeros(points.shape[:3], bool)
    grid[possible] = allowed
    return grid, points, depth


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


def fill_column(lumen: Lumen, opening: Opening, column: Column, spacing: float) -> Floats:
    """Blood at the start: a cubic lattice that stands in the lumen behind an opening.

    Every particle is half a spacing or more from the surface and connected to the opening
    through others; its depth is counted straight down from the opening's plane.

    Args:
        lumen: The closed surface.
        opening: Where the column stands.
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
            found = _connected(lumen, opening, spacing, offset, deepest, wanted)
            if found is not None:
                return found
            if deepest >= reach:
                break
            deepest = min(reach, offset + 1.6 * (deepest - offset))
    grid, points, depth = _component(lumen, opening, spacing, offset, deepest)
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


def _component(
    lumen: Lumen, opening: Opening, spacing: float, offset: float, deepest: float
) -> tuple[Booleans, Floats, Floats]:
    """`_lattice` without the places that are not connected to the opening."""
    grid, points, depth = _lattice(lumen, opening, spacing, offset, deepest)
    if not len(depth):
        return grid, points, depth
    return _joined(grid, points, opening), points, depth


def _joined(grid: Booleans, points: Floats, opening: Opening) -> Booleans:
    """The part of a lattice that hangs together with its top layer below the opening."""
    label, _ = ndimage.label(grid)
    for layer in range(min(3, len(grid))):
        # Where the rim is oblique the first layers may hold no particle.
        apart = points[layer] - opening.centre
        apart = apart + (-(apart @ opening.normal))[..., None] * opening.normal
        near = grid[layer] & (np.linalg.norm(apart, axis=2) < 2.0 * opening.radius)
        names = np.unique(label[layer][near])
        if len(names):
            return np.isin(label, names)
    return np.zeros_like(grid)


def _connected(
    lumen: Lumen, opening: Opening, spacing: float, offset: float, deepest: float, wanted: int
) -> Floats | None:
    """The `wanted` connected places of smallest depth (wanted, 3) [m], or None if fewer."""
    grid, points, depth = _lattice(lumen, opening, spacing, offset, deepest)
    first = int(np.searchsorted(depth, offset))
    low, high = first, len(depth)
    if _joined(grid, points, opening)[first:].sum() < wanted:
        return None
    while low < high:  # least number of layers whose connected part is large enough
        middle = (low + high) // 2
        if _joined(grid[:middle], points[:middle], opening)[first:].sum() >= wanted:
            high = middle
        else:
            low = middle + 1
    joined = _joined(grid[:low], points[:low], opening)
    layer, row, column = np.nonzero(joined[first:])
    chosen = points[first:low][layer, row, column]
    # In the last layer the places nearest to its middle stay.
    last = chosen[layer == layer.max()]
    aside = np.linalg.norm(chosen - last.mean(axis=0), axis=1)
    order = np.lexsort((column, row, np.round(aside / spacing, 6), layer))[:wanted]
    return chosen[order][::-1].copy()
