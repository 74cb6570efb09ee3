"""Flow extensions: where strands cross an opening, and where the proxies of the extension stand."""

import math

import numpy as np
import pytest

from reference import between
from taichi_sph.boundary.flow_extension import buffer_sites, flow_extension, rim_distance
from taichi_sph.geometry.mesh import plane_axes
from taichi_sph.geometry.openings import Opening


def circle(radius: float, count: int = 96) -> np.ndarray:
    turn = 2.0 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)


def ellipse(radius: float) -> np.ndarray:
    return circle(radius) * [1.4, 0.8]


def bean(radius: float) -> np.ndarray:
    turn = 2.0 * np.pi * np.arange(120) / 120
    r = radius * (1.0 + 0.25 * np.cos(2.0 * turn) - 0.15 * np.cos(turn))
    return r[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)


RIMS = {"circle": circle, "ellipse": ellipse, "bean": bean}
NORMAL = np.array([0.36, -0.48, 0.8])
CENTRE = np.array([0.02, -0.01, 0.03])


def in_space(flat: np.ndarray) -> tuple[np.ndarray, Opening]:
    """A rim (n, 2) in a slanting plane, and its opening."""
    first, second = plane_axes(NORMAL)
    a, b = flat.T, np.roll(flat, -1, axis=0).T
    area = 0.5 * abs(float((a[0] * b[1] - b[0] * a[1]).sum()))
    rim = CENTRE + flat[:, :1] * first + flat[:, 1:] * second
    radius = math.sqrt(area / math.pi)
    return rim, Opening("inlet", CENTRE, NORMAL, radius, area, True)


def finely(polygon: np.ndarray) -> np.ndarray:
    """Many points on a closed polygon, twenty to an edge."""
    share = np.arange(20)[:, None, None] / 20.0
    after = np.roll(polygon, -1, axis=0)
    return (polygon + share * (after - polygon)).reshape(-1, polygon.shape[1])


@pytest.mark.parametrize("shape", RIMS)
def test_the_distance_to_a_polygon_is_that_to_its_nearest_point(shape):
    polygon = RIMS[shape](5e-3)
    points = np.random.default_rng(0).uniform(-8e-3, 8e-3, (200, 2))
    found = rim_distance(points, polygon)
    near = between(points, finely(polygon)).min(axis=1)
    # Of points a twentieth of an edge apart the nearest is at most half of that farther.
    step = np.linalg.norm(np.roll(polygon, -1, axis=0) - polygon, axis=1).max() / 20.0
    assert np.all(found <= near + 1e-15)
    assert np.all(near - found <= 0.5 * step)


@pytest.mark.parametrize("spacing", [0.7e-3, 1.2e-3, 1.6e-3])
@pytest.mark.parametrize("shape", RIMS)
def test_sites_are_a_spacing_apart_and_half_a_spacing_inside_the_rim(shape, spacing):
    rim, opening = in_space(RIMS[shape](5e-3))
    sites = buffer_sites(rim, opening, spacing)
    assert np.abs((sites - CENTRE) @ NORMAL).max() < 1e-12
    apart = between(sites, sites)
    np.fill_diagonal(apart, np.inf)
    np.testing.assert_allclose(apart.min(axis=1), spacing, rtol=1e-9)
    rim = finely(rim)
    away = between(sites, rim)
    assert away.min() > 0.498 * spacing
    # Inside: these rims see all of themselves from their centre, and the centre from within.
    facing = (sites - CENTRE) @ (rim - CENTRE).T
    facing /= np.linalg.norm(rim - CENTRE, axis=1)
    behind = np.linalg.norm(rim - CENTRE, axis=1)[facing.argmax(axis=1)]
    assert np.all(np.linalg.norm(sites - CENTRE, axis=1) < behind)


@pytest.mark.parametrize("spacing", [0.4e-3, 0.7e-3, 1.2e-3, 1.6e-3])
@pytest.mark.parametrize("shape", RIMS)
def test_sites_take_up_the_opening_but_for_its_rim(shape, spacing):
    rim, opening = in_space(RIMS[shape](5e-3))
    taken = len(buffer_sites(rim, opening, spacing)) * spacing**2
    around = np.linalg.norm(np.roll(rim, -1, axis=0) - rim, axis=1).sum()
    # Lattice points in an area fill it but for a few; all keep half a spacing from the rim.
    few = 2.0 * spacing**2
    assert opening.area - 0.5 * around * spacing - few < taken < opening.area + few


@pytest.mark.parametrize("shape", RIMS)
def test_the_extension_stands_a_setback_outside_the_rim_evenly_and_faces_out(shape):
    rim, opening = in_space(RIMS[shape](5e-3))
    spacing, setback, depth = 0.7e-3, 0.65e-3, 5e-3
    points, normals = flow_extension(rim, opening, spacing, setback, depth)
    along = (points - CENTRE) @ NORMAL
    # In rings a spacing apart, the first half a spacing beyond the plane, as far as asked.
    levels = np.unique(along.round(9))
    np.testing.assert_allclose(levels, (np.arange(len(levels)) + 0.5) * spacing, atol=1e-8)
    assert depth - 0.5 * spacing <= levels[-1] < depth + 0.5 * spacing
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-12)
    assert np.abs(normals @ NORMAL).max() < 1e-12
    flat = points - along[:, None] * NORMAL
    # Chords of a spacing lie inside a rim that curves by 1/R: by spacing^2/(8 R) at most twice.
    bent = 0.05 * setback
    outline = finely(rim)
    np.testing.assert_allclose(between(flat, outline).min(axis=1), setback, atol=bent)
    assert between(flat + 0.1 * setback * normals, outline).min() > 1.05 * setback
    assert (
        np.linalg.norm(flat - CENTRE, axis=1).min() > np.linalg.norm(outline - CENTRE, axis=1).min()
    )
    # Their feet on the rim are evenly spread: as many to every piece of it.
    feet = flat - setback * normals
    ring = feet[np.abs(along - levels[1]) < 1e-9]
    step = np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1)
    assert step.max() < 1.03 * step.min()
    assert step.mean() == pytest.approx(spacing, rel=0.03)
    # Each ring stands on the gaps of the one before.
    first = feet[np.abs(along - levels[0]) < 1e-9]
    assert between(ring, first).min() > 0.45 * spacing
