"""Surface of a tool: its proxies, what lies outside it, and what is refused."""

import numpy as np
import pytest
import trimesh

from builders import KERNEL, WALL_SPACING, D, R, calibration
from reference import proxy_volumes, separations
from taichi_sph.boundary.tool_surface import read_tool_surface
from taichi_sph.errors import InputError
from taichi_sph.scene import ToolTable
from tool_stage import BALL, FACET, globe, sample_surface


def test_proxies_stand_a_setback_inside_the_surface_and_evenly(surface):
    centre = np.array([0.0, 0.0, BALL])
    r = np.linalg.norm(surface.position - centre, axis=1)
    np.testing.assert_allclose(r, BALL - calibration().setback, atol=FACET * BALL)
    outward = (surface.position - centre) / r[:, None]
    np.testing.assert_allclose(-surface.normal, outward, atol=0.1)
    np.testing.assert_allclose(np.linalg.norm(surface.normal, axis=1), 1.0, rtol=1e-12)
    assert len(r) == pytest.approx(4.0 * np.pi * BALL**2 / WALL_SPACING**2, rel=0.03)
    feet = surface.position - calibration().setback * surface.normal
    apart = np.linalg.norm(separations(feet, feet), axis=-1)
    np.fill_diagonal(apart, np.inf)
    # Even points: no two nearer than half of the mean spacing.
    assert apart.min() > 0.5 * WALL_SPACING
    assert np.linalg.norm(surface.position, axis=1).max() == pytest.approx(surface.radius)


def test_volumes_of_the_proxies_are_equation_3(surface):
    np.testing.assert_allclose(surface.volume, proxy_volumes(surface.position, R), rtol=1e-12)


def test_a_surface_knows_what_is_outside_it_and_how_far(surface):
    points = np.random.default_rng(1).uniform(-2.0 * BALL, 3.0 * BALL, (500, 3))
    away = np.linalg.norm(points - [0.0, 0.0, BALL], axis=1) - BALL
    certain = np.abs(away) > FACET * BALL
    np.testing.assert_array_equal(surface.outside(points)[certain], away[certain] > 0.0)
    np.testing.assert_allclose(surface.distance(points), np.abs(away), atol=FACET * BALL)


def test_a_scale_makes_metres_of_the_file(tmp_path, surface):
    large = globe()
    large.apply_scale(1e3)
    found = sample_surface(tmp_path, large, 1e-3)
    # The file holds single precision.
    np.testing.assert_allclose(found.radius, surface.radius, rtol=1e-5)
    assert len(found.position) == len(surface.position)


def test_no_proxy_of_a_thin_tool_stands_outside_it(tmp_path):
    # A needle of 0.6 mm in blood of 1 mm: the setback is three times its radius.
    needle = trimesh.creation.cylinder(radius=0.3 * D, height=12.0 * D, sections=24)
    try:
        found = sample_surface(tmp_path, needle)
    except InputError:
        return  # refused is as good
    away = np.where(found.outside(found.position), found.distance(found.position), 0.0)
    assert away.max() < FACET * D


def pierced() -> trimesh.Trimesh:
    surface = globe()
    surface.update_faces(np.arange(len(surface.faces)) > 0)
    return surface


def inside_out() -> trimesh.Trimesh:
    surface = globe()
    surface.invert()
    return surface


def in_two() -> trimesh.Trimesh:
    other = globe()
    other.apply_translation([3.0 * BALL, 0.0, 0.0])
    return trimesh.util.concatenate([globe(), other])


@pytest.mark.parametrize("mistake", [pierced, inside_out, in_two])
def test_a_surface_with_a_hole_or_inside_out_or_in_two_is_one_sentence(tmp_path, mistake):
    with pytest.raises(InputError) as error:
        sample_surface(tmp_path, mistake())
    assert str(error.value).startswith(f"{tmp_path / 'tool.ply'}: ")
    assert "\n" not in str(error.value)


def test_a_surface_that_is_not_there_is_one_sentence(tmp_path):
    table = ToolTable(surface="none.stl", position=(0.0, 0.0, 0.0))
    with pytest.raises(InputError) as error:
        read_tool_surface(table, tmp_path, WALL_SPACING, calibration().setback, KERNEL)
    expected = f"{tmp_path / 'none.stl'}: cannot read the surface: No such file or directory"
    assert str(error.value) == expected
