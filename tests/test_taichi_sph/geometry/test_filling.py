"""Blood at the start."""

import numpy as np
import pytest

from meshes import (
    bent,
)
from places import VESSELS
from taichi_sph.geometry import mesh
from taichi_sph.geometry.caps import find_caps
from taichi_sph.geometry.findings import check_vessel
from taichi_sph.geometry.vessel import Vessel, build_vessel, read_vessel
from taichi_sph.scene import Column, OpeningTable, read_scene

SCENES = sorted(path.relative_to(VESSELS).as_posix() for path in VESSELS.glob("*/scene.toml"))


def test_a_box_is_filled_to_the_last_place() -> None:
    scene = read_scene(VESSELS / "box" / "scene.toml")
    vessel = read_vessel(scene)
    blood = vessel.fill_column(scene.column, 1e-3)
    assert len(blood) == 16 * 16 * 20
    assert blood.min(axis=0) == pytest.approx([-7.5e-3, -7.5e-3, -19.5e-3], abs=1e-8)
    assert blood.max(axis=0) == pytest.approx([7.5e-3, 7.5e-3, -0.5e-3], abs=1e-8)


@pytest.mark.parametrize("wanted", [500, 1234])
def test_the_column_has_the_number_asked_for(aorta: Vessel, wanted: int) -> None:
    spacing = 0.9e-3
    column = Column(opening="inlet_abdominal_aorta", particles=wanted)
    blood = aorta.fill_column(column, spacing)
    assert len(blood) == wanted
    assert len(np.unique(np.round(blood / spacing * 100), axis=0)) == wanted
    assert aorta.signed_distance(blood).max() <= -0.499 * spacing
    opening = aorta.openings[0]
    depth = (opening.centre - blood) @ opening.normal
    assert depth.min() == pytest.approx(0.5 * spacing)
    # As shallow as can be: it fills all layers but its last.
    full = aorta.fill_column(
        Column(opening="inlet_abdominal_aorta", height=depth.max() - 0.4 * spacing), spacing
    )
    assert len(full) <= wanted


@pytest.mark.parametrize("name", SCENES)
def test_shipped_scenes_fill_strictly_inside_and_leak_nothing(name: str) -> None:
    scene = read_scene(VESSELS / name)
    vessel = read_vessel(scene)
    spacing = scene.discretization.spacing
    blood = vessel.fill_column(scene.column, spacing)
    assert 3000 <= len(blood) <= 6000
    assert vessel.signed_distance(blood).max() <= -0.498 * spacing
    assert vessel.count_leaks(blood) == 0
    assert vessel.narrowest / spacing > 6.0
    # The column stands below its opening: gravity points into the lumen there.
    opening = vessel.opening(scene.column.opening)
    gravity = np.array(scene.gravity)
    assert gravity @ opening.normal < -0.5 * np.linalg.norm(gravity)
    assert all(finding.good for finding in check_vessel(vessel))


@pytest.mark.parametrize("name", ["aortoiliac/A.toml", "portal_vein/B.toml"])
def test_scenes_of_the_papers_sizes_hold_16_000_and_32_000(name: str) -> None:
    scene = read_scene(VESSELS / name)
    vessel = read_vessel(scene)
    spacing, column = scene.discretization.spacing, scene.column
    assert column.particles == 16_000
    proxies = vessel.wall_area / (spacing * scene.discretization.wall_spacing_ratio) ** 2
    assert proxies == pytest.approx(56_000 if "A" in name else 73_000, rel=0.02)
    twice = vessel.fill_column(Column(opening=column.opening, particles=32_000), spacing)
    assert len(twice) == 32_000


def test_a_column_stays_in_the_leg_of_its_opening() -> None:
    vertices, faces = bent()
    ends = [
        mesh.region_plane(vertices, faces[cap.faces])[0]
        for cap in find_caps(vertices, faces, "bend")
    ]
    left, right = sorted(ends, key=lambda centre: centre[0])
    openings = {
        name: OpeningTable(centre=tuple(centre)) for name, centre in (("a", left), ("b", right))
    }
    vessel = build_vessel(vertices, faces, openings, 1.0, "bend")
    blood = vessel.fill_column(Column(opening="a", height=0.004), 1e-3)
    assert blood[:, 0].max() < 0  # not in the other leg, though it is as deep there
    both = vessel.fill_column(Column(opening="a", particles=1800), 1e-3)
    assert both[:, 0].max() > 0  # round the bend
