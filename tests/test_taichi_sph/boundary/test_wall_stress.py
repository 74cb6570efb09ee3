"""Tests of wall shear stress: the force that blood has felt, turned round."""

import math
from pathlib import Path

import numpy as np
import pytest

from app.run.wall_stress_file import polydata
from app.validation import flows
from app.validation.flows import DENSITY, VISCOSITY, Liquid
from app.validation.wall_stress import watch_wall
from taichi_sph.boundary.wall_stress import WallStress
from taichi_sph.errors import RunError
from taichi_sph.fluid.rheology import Newtonian
from taichi_sph.geometry.vtk_formats import read_vtp
from taichi_sph.scene import read_scene
from taichi_sph.simulation import Simulation

RADIUS = 1e-3
ACROSS = 6
SPEED = 0.02
"""[m/s]"""
DRIVE = 4.0 * VISCOSITY * SPEED / RADIUS**2
"""[Pa/m]"""


@pytest.fixture(scope="module")
def tube() -> Simulation:
    d = 2.0 * RADIUS / ACROSS
    liquid = Liquid(Newtonian(VISCOSITY), 10.0 * SPEED, d, background_pressure=0.5)
    return flows.tube(liquid, RADIUS, DRIVE)


@pytest.fixture(scope="module")
def watched(tube: Simulation) -> WallStress:
    return watch_wall(tube)


@pytest.fixture(autouse=True)
def start_anew(tube: Simulation, watched: WallStress):
    tube.particles.velocity.fill(0.0)
    watched.reset()


def slide(tube: Simulation, speed: float) -> None:
    """Give all blood the same velocity along the tube."""
    flows.set_velocity(tube, lambda x: np.tile([0.0, 0.0, speed], (len(x), 1)))


def momentum(tube: Simulation) -> float:
    """Along the tube [N s]."""
    velocity = tube.particles.velocity.to_numpy()[: tube.particles.count[None]]
    return float(velocity[:, 2].astype(float).sum() * tube.particles.mass)


def test_the_friction_is_what_the_drive_gives_and_blood_does_not_keep(
    tube: Simulation, watched: WallStress
) -> None:
    begin, before = tube.time, momentum(tube)
    for _ in range(200):
        tube.step(1.0)
    time = tube.time - begin
    given = DRIVE / DENSITY * time * tube.particles.mass * tube.particles.count[None]
    sums = watched.impulse, watched.artificial_impulse
    taken = sum(field.to_numpy()[:, 2].astype(float).sum() for field in sums)
    # Proxies are no smooth wall: their pressure acts along it too, some thousandths here.
    assert taken == pytest.approx(given - (momentum(tube) - before), rel=0.005)
    assert 0.01 * given < taken < given


def test_the_stress_is_along_the_wall_and_everywhere_the_same(
    tube: Simulation, watched: WallStress
) -> None:
    slide(tube, SPEED)
    tube.step(1e-9)
    force = watched.impulse.to_numpy()[:, 2].astype(float).sum() / 1e-9
    stress = watched.look()
    area = 2.0 * math.pi * RADIUS * flows.SLAB * 2.0 * RADIUS / ACROSS
    assert not watched.impulse.to_numpy().any(), "a look begins anew"
    # In flow that slips uniformly; rings of blood are not even along the wall.
    assert np.abs(np.einsum("ka,ka->k", stress, watched.normals)).max() < 1e-6 * stress[:, 2].max()
    assert stress[:, 2].std() < 0.15 * stress[:, 2].mean()
    assert watched.result().mean[:, 2].mean() == pytest.approx(stress[:, 2].mean(), rel=1e-12)
    total = float((stress[:, 2] * area / len(stress)).sum())
    # Places are spread evenly; what a proxy stands for is some 4 % too little in so narrow a tube.
    assert total == pytest.approx(force, rel=0.06)


def test_averages_of_a_stress_that_turns(tube: Simulation, watched: WallStress) -> None:
    for speed, steps in ((SPEED, 3), (-SPEED, 1)):
        for _ in range(steps):
            slide(tube, speed)
            tube.step(1e-9)
        watched.look()
    result = watched.result()
    assert result.time == pytest.approx(4e-9)
    # Three parts one way and one the other: 1/2 (1 - 2/4).
    np.testing.assert_allclose(result.osi, 0.25, atol=0.01)
    np.testing.assert_allclose(result.mean[:, 2] / result.tawss, 0.5, atol=0.02)
    assert (np.linalg.norm(result.artificial, axis=1) <= result.tawss).all()


def test_its_sums_go_on_from_a_saved_state(tube: Simulation, watched: WallStress) -> None:
    slide(tube, SPEED)
    tube.step(1e-9)
    saved = watched.save_state()
    expected = watched.result()
    watched.reset()
    assert not watched.result().tawss.any()
    watched.load_state(saved)
    found = watched.result()
    assert found.time == expected.time
    for name in ("mean", "tawss", "osi", "artificial"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_a_model_without_pair_forces_has_no_friction(tube, watched, monkeypatch) -> None:
    monkeypatch.setattr(type(tube.model), "pair_coefficients", None)
    with pytest.raises(RunError, match="no friction on the wall"):
        watched.before_drift(1e-6, tube.model)


def test_the_file_is_a_surface_with_the_stress_at_its_points(tube, watched) -> None:
    slide(tube, SPEED)
    tube.step(1e-9)
    watched.look()
    result = watched.result()
    faces = np.array([[0, 1, 2], [2, 3, 0]])
    text = polydata(result, faces)
    found = read_vtp(text.encode())
    np.testing.assert_allclose(found.points, result.vertices, rtol=1e-8, atol=1e-12)
    assert found.corners.tolist() == faces.ravel().tolist()
    for name in ("WSS", "TAWSS", "OSI", "ArtificialWSS"):
        assert f'Name="{name}"' in text


@pytest.mark.validation
def test_a_state_that_has_been_watched_is_watched_on(box: Path) -> None:
    scene = read_scene(box / "scene.toml")
    first, second = (Simulation.from_scene(scene) for _ in range(2))
    measured = first.measure_wall_stress()
    first.advance_to(0.01)
    assert first.measure_wall_stress() is measured
    state = first.save_state()
    second.load_state(state)
    found, expected = second.measure_wall_stress().result(), measured.result()
    assert found.time == expected.time == pytest.approx(0.01)
    np.testing.assert_array_equal(found.tawss, expected.tawss)
    assert found.tawss.max() > 0.0
    vessel = first.vessel
    assert len(found.vertices) == len(vessel.wall_vertices)
    # The lumen is a box: normals at its corners point out of it.
    middle = 0.5 * (found.vertices.min(axis=0) + found.vertices.max(axis=0))
    assert (((found.vertices - middle) * found.normals).sum(axis=1) > 0.0).all()
