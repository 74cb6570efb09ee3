"""Tests of how runs begin: as much blood as there is room for, and still."""

import msgspec
import numpy as np
import pytest

from app.scenes.library import find_scene
from taichi_sph import settling
from taichi_sph.assemble import assemble
from taichi_sph.geometry.vessel import Vessel, read_vessel
from taichi_sph.scene import Scene
from taichi_sph.simulation import Simulation

HEIGHT = 0.01
"""Of the column [m]."""
INSTANT = 1e-12
"""A step in which nothing moves [s]."""
PLACES = {"f64": 1e-12, "f32": 1e-6}
"""Of the lumen's size."""


def tube(spacing: float, **column) -> tuple[Scene, Vessel]:
    """The shipped tube with a column at another spacing [m]."""
    scene = find_scene("tube")
    grid = msgspec.structs.replace(scene.discretization, spacing=spacing)
    given = {"height": None, "particles": None} | column
    scene = msgspec.structs.replace(
        scene, discretization=grid, column=msgspec.structs.replace(scene.column, **given)
    )
    return scene, read_vessel(scene)


@pytest.fixture(scope="module")
def coarse() -> Simulation:
    return begun(1.25e-3)


def begun(spacing: float, **column) -> Simulation:
    scene, vessel = tube(spacing, **column or {"height": HEIGHT})
    return Simulation.from_scene(scene, vessel=vessel)


@pytest.mark.parametrize("spacing", [1.25e-3, 1.6e-3])
def test_a_column_is_the_same_volume_at_every_spacing(spacing: float, coarse: Simulation) -> None:
    simulation = coarse if spacing == 1.25e-3 else begun(spacing)
    area = coarse.vessel.opening(coarse.scene.column.opening).area
    volume = len(simulation.positions()) * spacing**3
    # A particle's volume is 0.2 and 0.5 % of the column's.
    assert volume == pytest.approx(area * HEIGHT, rel=0.01)


def test_it_is_still_even_and_below_its_opening(coarse: Simulation, precision: str) -> None:
    opening, spacing = coarse.vessel.opening(coarse.scene.column.opening), 1.25e-3
    x = coarse.positions().astype(float)
    depth = (opening.centre - x) @ opening.normal
    close = PLACES[precision] * np.ptp(coarse.vessel.vertices)
    assert depth.min() >= 0.5 * spacing - close
    assert depth.max() <= HEIGHT + 0.5 * spacing
    assert coarse.vessel.contains(x).all()
    coarse.step(INSTANT)
    ratio = coarse.particles.density.to_numpy()[: len(x)] / coarse.scene.blood.density
    assert np.percentile(ratio, 99.5) < 0.999
    # Half of so coarse a column is beside its ends.
    assert np.median(ratio) > 0.97
    # Without pressure it only falls.
    acceleration = coarse.particles.acceleration.to_numpy()[: len(x)]
    np.testing.assert_allclose(np.median(acceleration, axis=0), coarse.gravity, atol=1e-3)


def test_a_number_of_particles_is_kept_and_its_depth_follows() -> None:
    spacing, count = 1.25e-3, 150
    simulation = begun(spacing, particles=count)
    opening = simulation.vessel.opening(simulation.scene.column.opening)
    x = simulation.positions().astype(float)
    assert len(x) == count
    depth = ((opening.centre - x) @ opening.normal).max() + 0.5 * spacing
    assert depth == pytest.approx(count * spacing**3 / opening.area, abs=spacing)


@pytest.mark.validation
def test_the_start_is_kept_and_found_again(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(settling, "CACHE_FROM", 10)
    scene, vessel = tube(1.6e-3, height=HEIGHT)
    first = assemble(scene, vessel).initial_blood
    monkeypatch.setattr(settling, "_settled", None)  # not asked again
    assert assemble(scene, vessel).initial_blood.tobytes() == first.tobytes()
    higher, _ = tube(1.6e-3, height=1.1 * HEIGHT)
    with pytest.raises(TypeError):
        assemble(higher, vessel)
