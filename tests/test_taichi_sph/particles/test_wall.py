"""Tests of what the proxies know of the wall's shape."""

import numpy as np
import pytest

from app.validation.flows import tube_wall
from taichi_sph.particles.smoothing_kernel import WendlandC2
from taichi_sph.particles.wall import LARGEST_CURVATURE, wall_curvature

D = 1e-3
"""Spacing of blood and proxies, and h_s [m]."""
KERNEL = WendlandC2(2.0 * D)
SETBACK = 0.92 * D
SAMPLED = 0.13
"""Of the curvature: neighbours lie on a lattice, not evenly all round."""


def curvature(position: np.ndarray, normal: np.ndarray, period=None) -> np.ndarray:
    return wall_curvature(position + SETBACK * normal, normal, KERNEL, SETBACK, period)


def sphere(radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Points d apart on a sphere, in Fibonacci's order, and their normals."""
    n = round(4.0 * np.pi * (radius / D) ** 2)
    z = 1.0 - (2.0 * np.arange(n) + 1.0) / n
    angle = np.pi * (1.0 + 5.0**0.5) * np.arange(n)
    normal = np.column_stack([*(np.sqrt(1.0 - z**2) * (np.cos(angle), np.sin(angle))), z])
    return radius * normal, normal


@pytest.mark.parametrize("across", [4, 6, 10, 20])
def test_the_curvature_of_a_tube_is_one_over_its_radius(across):
    length = 12.0 * D
    wall, normal = tube_wall(0.5 * across * D, D, 0.0, length, True)
    found = curvature(wall, normal, np.array([0.0, 0.0, length]))
    np.testing.assert_allclose(found, 2.0 / across, rtol=SAMPLED)


def test_a_sphere_is_curved_twice():
    wall, normal = sphere(12.0 * D)
    # The setback is taken off as a tube's is: 2/12.92, and from it 1/(1 - 0.92 of that).
    np.testing.assert_allclose(curvature(wall, normal), 2.0 / 12.0, rtol=SAMPLED)


def test_a_plane_is_not_curved_nor_is_a_wall_that_bulges_into_blood():
    x, y = np.meshgrid(*[np.arange(9) * D] * 2, indexing="ij")
    plane = np.column_stack([x.ravel(), y.ravel(), 0.0 * x.ravel()])
    up = np.tile([0.0, 0.0, 1.0], (len(plane), 1))
    assert not wall_curvature(plane, up, KERNEL, SETBACK).any()
    rod, outward = tube_wall(4.0 * D, D, 0.0, 12.0 * D, True)
    assert not wall_curvature(rod, -outward, KERNEL, SETBACK).any()


def test_neither_an_edge_nor_a_septum_is_curved():
    x, y = np.meshgrid(*[np.arange(9) * D] * 2, indexing="ij")
    floor = np.column_stack([x.ravel(), y.ravel(), 0.0 * x.ravel()])
    side = floor[:, [2, 0, 1]]
    back = floor - [0.0, 0.0, 0.3 * D]
    walls = np.concatenate([floor, side, back])
    normals = np.repeat([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], len(floor), 0)
    assert not wall_curvature(walls, normals, KERNEL, SETBACK).any()


def test_the_curvature_is_bounded():
    wall, normal = tube_wall(1.2 * D, D, 0.0, 12.0 * D, True)
    assert curvature(wall, normal).max() == LARGEST_CURVATURE


def test_a_wall_without_proxies_has_no_curvature():
    assert wall_curvature(np.zeros((0, 3)), np.zeros((0, 3)), KERNEL, SETBACK).shape == (0,)
