"""Flow extensions: the short tube behind a driven opening, and where blood crosses the plane."""

import math

import numpy as np

from taichi_sph.geometry.mesh import Floats, inside_polygon, plane_axes
from taichi_sph.geometry.openings import Opening


def buffer_sites(rim: Floats, opening: Opening, spacing: float) -> Floats:
    """Where strands cross an opening's plane: a square lattice half a spacing from the rim, (n, 3).

    Args:
        rim: closed polygon round the opening (m, 3) [m].
        opening: whose plane it is.
        spacing: of the strands [m].
    """
    first, second = plane_axes(opening.normal)
    flat = np.stack([(rim - opening.centre) @ first, (rim - opening.centre) @ second], axis=1)
    low, high = flat.min(axis=0), flat.max(axis=0)
    best = np.zeros((0, 2))
    middle = 0.5 * (low + high)
    for shift in ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5)):
        lines = []
        for a in range(2):
            most = math.ceil((high[a] - low[a]) / spacing)
            lines.append(middle[a] + (np.arange(-most, most + 1) + shift[a]) * spacing)
        points = np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 2)
        points = points[inside_polygon(points, flat)]
        points = points[rim_distance(points, flat) >= 0.499 * spacing]
        if len(points) > len(best):
            best = points
    return opening.centre + best[:, :1] * first + best[:, 1:] * second


def rim_distance(points: Floats, polygon: Floats) -> Floats:
    """Distance of points (n, 2) to a closed polygon (m, 2), (n,)."""
    a, along = polygon, np.roll(polygon, -1, axis=0) - polygon
    apart = points[:, None] - a
    foot_at = (apart * along).sum(axis=2) / np.maximum((along**2).sum(axis=1), 1e-300)
    foot = apart - np.clip(foot_at, 0.0, 1.0)[..., None] * along
    return np.asarray(np.linalg.norm(foot, axis=2).min(axis=1))


def flow_extension(
    rim: Floats, opening: Opening, spacing: float, setback: float, depth: float
) -> tuple[Floats, Floats]:
    """Proxies of the flow extension behind an opening, and their normals, (n, 3) each.

    Args:
        rim: closed polygon round the opening (m, 3) [m].
        opening: where the extension begins.
        spacing: of the proxies [m].
        setback: how far behind the lumen they stand [m].
        depth: length of the extension [m].
    """
    after = np.roll(rim, -1, axis=0)
    length = np.linalg.norm(after - rim, axis=1)
    reached = np.concatenate([[0.0], np.cumsum(length)])
    count = max(6, round(float(reached[-1]) / spacing))
    points, normals = [], []
    for ring in range(math.ceil(depth / spacing)):
        place = (np.arange(count) + 0.5 * (ring % 2)) / count * reached[-1]
        edge = np.minimum(np.searchsorted(reached, place, side="right") - 1, len(rim) - 1)
        along = (place - reached[edge]) / np.maximum(length[edge], 1e-300)
        foot = rim[edge] + along[:, None] * (after - rim)[edge]
        # Out of the lumen: square to the rim's chord over a spacing and to the opening's normal.
        ahead, behind = np.roll(foot, -1, axis=0), np.roll(foot, 1, axis=0)
        out = np.cross(ahead - behind, opening.normal)
        out /= np.linalg.norm(out, axis=1, keepdims=True)
        out *= np.sign(((foot - opening.centre) * out).sum(axis=1))[:, None]
        points.append(foot + setback * out + (ring + 0.5) * spacing * opening.normal)
        normals.append(out)
    return np.concatenate(points), np.concatenate(normals)
