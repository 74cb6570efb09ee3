from pathlib import Path

import pytest

from taichi_sph.errors import InputError
from taichi_sph.scene import CassonTable, NewtonianTable, parse_scene, read_scene

GOOD = """
title = "Tube"
duration = 0.1
frame_interval = 0.01
gravity = [0.0, 0.0, -9.81]

[vessel]
surface = "wall.stl"

[openings.top]
centre = [0.0, 0.0, 1.0]
state = "open"

[column]
opening = "top"
height = 0.01

[blood]
density = 1060.0

[blood.rheology]
model = "casson"

[discretization]
spacing = 1e-3
"""

# What is written, what it is replaced by, what the user reads.
MISTAKES = {
    "unknown key in a table": (
        "spacing = 1e-3",
        "spacing = 1e-3\nsupport = 2.0",
        "scene.toml: discretization: unknown key support; allowed: spacing, support_ratio, "
        "wall_spacing_ratio, sound_speed_ratio, courant_number, integrator, viscous_form",
    ),
    "unknown key at the top": (
        "duration = 0.1",
        "duration = 0.1\ncolour = 3",
        "scene.toml: unknown key colour; allowed: title, vessel, column, discretization, duration, "
        "frame_interval, gravity, openings, blood",
    ),
    "unknown table": (
        "[column]",
        "[colum]",
        "scene.toml: unknown key colum; allowed: title, vessel, column, discretization, duration, "
        "frame_interval, gravity, openings, blood",
    ),
    "key of another law": (
        'model = "casson"',
        'model = "newtonian"\nyield_stress = 3.0',
        "scene.toml: blood.rheology: unknown key yield_stress; allowed: model, viscosity",
    ),
    "key that the reader sets": (
        "duration = 0.1",
        'duration = 0.1\nfolder = "/"',
        "scene.toml: unknown key folder",
    ),
    "text for a number": (
        "spacing = 1e-3",
        'spacing = "1 mm"',
        "scene.toml: discretization.spacing: found '1 mm'; expected float",
    ),
    "truth for a number": (
        "spacing = 1e-3",
        "spacing = true",
        "scene.toml: discretization.spacing: found True; expected float",
    ),
    "half a particle": (
        "height = 0.01",
        "particles = 1.5",
        "scene.toml: column.particles: found 1.5; expected int | null",
    ),
    "two components": (
        "gravity = [0.0, 0.0, -9.81]",
        "gravity = [0.0, -9.81]",
        "scene.toml: gravity: found [0.0, -9.81]; expected array of length 3",
    ),
    "negative density": (
        "density = 1060.0",
        "density = -1060.0",
        "scene.toml: blood.density: found -1060.0; expected float > 0.0",
    ),
    "spacing that is no number": (
        "spacing = 1e-3",
        "spacing = nan",
        "scene.toml: discretization.spacing: found nan; expected float > 0.0",
    ),
    "no particles": (
        "height = 0.01",
        "particles = 0",
        "scene.toml: column.particles: found 0; expected int >= 1",
    ),
    "support too wide": (
        "spacing = 1e-3",
        "spacing = 1e-3\nsupport_ratio = 5.0",
        "scene.toml: discretization.support_ratio: found 5.0; expected float <= 4.0",
    ),
    "endless run": (
        "duration = 0.1",
        "duration = inf",
        "scene.toml: duration: found inf; expected float < 1000000000000.0",
    ),
    "gravity of a star": (
        "gravity = [0.0, 0.0, -9.81]",
        "gravity = [0.0, 0.0, -9.81e9]",
        "scene.toml: gravity: (0.0, 0.0, -9810000000.0) m/s^2 is not a plausible body force",
    ),
    "missing key": (
        "spacing = 1e-3",
        "",
        "scene.toml: discretization: the key spacing is missing",
    ),
    "missing key at the top": (
        "duration = 0.1",
        "",
        "scene.toml: the key duration is missing",
    ),
    "neither height nor particles": (
        "height = 0.01",
        "",
        "scene.toml: column: give height [m] or particles, one of the two",
    ),
    "height and particles": (
        "height = 0.01",
        "height = 0.01\nparticles = 100",
        "scene.toml: column: give height [m] or particles, one of the two",
    ),
    "opening that is not there": (
        'opening = "top"',
        'opening = "bottom"',
        "scene.toml: column.opening: 'bottom' is not an opening; allowed: top",
    ),
    "opening neither open nor capped": (
        'state = "open"',
        'state = "ajar"',
        "scene.toml: openings.top.state: found 'ajar'; allowed: open, capped",
    ),
    "infinite spacing": (
        "spacing = 1e-3",
        "spacing = inf",
        "scene.toml: discretization.spacing: found inf; expected float < 1000000000000.0",
    ),
    "law that is not there": (
        'model = "casson"',
        'model = "carreau"',
        "scene.toml: blood.rheology.model: found 'carreau'; allowed: newtonian, casson",
    ),
    "no TOML": (
        'title = "Tube"',
        "title = Tube",
        "scene.toml: not a TOML file: Invalid value (at line 2, column 9)",
    ),
}


def parse(text: str):
    return parse_scene(text, "scene.toml", Path("/somewhere"), "tube")


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistake_is_told_in_one_sentence(mistake):
    written, instead, message = MISTAKES[mistake]
    assert GOOD.count(written) == 1
    with pytest.raises(InputError) as error:
        parse(GOOD.replace(written, instead))
    assert str(error.value) == message


def test_scene_is_what_the_file_says():
    scene = parse(GOOD)
    assert scene.column.height == 0.01
    assert scene.column.particles is None
    assert scene.gravity == (0.0, 0.0, -9.81)
    assert scene.openings["top"].centre == (0.0, 0.0, 1.0)
    assert scene.blood.rheology == CassonTable()
    assert (scene.folder, scene.name, scene.text) == ("/somewhere", "tube", GOOD)


def test_the_law_of_viscosity_is_chosen_by_its_name():
    scene = parse(GOOD.replace('model = "casson"', 'model = "newtonian"\nviscosity = 4e-3'))
    assert scene.blood.rheology == NewtonianTable(viscosity=4e-3)


def test_a_whole_number_is_a_number():
    assert parse(GOOD.replace("density = 1060.0", "density = 1060")).blood.density == 1060.0


def test_scene_cannot_be_changed():
    with pytest.raises(AttributeError):
        parse(GOOD).blood.density = 1.0


def test_a_scene_file_is_named_after_its_folder(tmp_path):
    path = tmp_path / "tube" / "scene.toml"
    path.parent.mkdir()
    path.write_text(GOOD)
    assert (read_scene(path).name, read_scene(path).folder) == ("tube", str(path.parent.resolve()))
    other = path.rename(path.with_name("wide.toml"))
    assert read_scene(other).name == "wide"


def test_a_missing_scene_file_is_told_in_one_sentence(tmp_path):
    path = tmp_path / "scene.toml"
    with pytest.raises(InputError) as error:
        read_scene(path)
    assert str(error.value) == f"{path}: cannot read the scene: No such file or directory"


def test_a_scene_file_that_is_no_text_is_told_in_one_sentence(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_bytes(b"title = \xff\xfe")
    with pytest.raises(InputError) as error:
        read_scene(path)
    assert str(error.value) == f"{path}: cannot read the scene: not UTF-8 text"
