from pathlib import Path

import pytest

from taichi_sph.errors import InputError
from taichi_sph.scene import CassonTable, NewtonianTable, ToolTable, parse_scene, read_scene

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
        "frame_interval, gravity, openings, blood, tool, wall",
    ),
    "unknown table": (
        "[column]",
        "[colum]",
        "scene.toml: unknown key colum; allowed: title, vessel, column, discretization, duration, "
        "frame_interval, gravity, openings, blood, tool, wall",
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
        "scene.toml: column: give height [m], particles or full = true, one of the three",
    ),
    "height and particles": (
        "height = 0.01",
        "height = 0.01\nparticles = 100",
        "scene.toml: column: give height [m], particles or full = true, one of the three",
    ),
    "height and full": (
        "height = 0.01",
        "height = 0.01\nfull = true",
        "scene.toml: column: give height [m], particles or full = true, one of the three",
    ),
    "not full": (
        "height = 0.01",
        "full = false",
        "scene.toml: column: give height [m], particles or full = true, one of the three",
    ),
    "full below an offset": (
        "height = 0.01",
        "full = true\noffset = 0.002",
        "scene.toml: column: an offset [m] leaves no full lumen",
    ),
    "full of text": (
        "height = 0.01",
        'full = "yes"',
        "scene.toml: column.full: found 'yes'; expected bool",
    ),
    "flow and pressure": (
        'state = "open"',
        "flow = 1e-5\npressure = 0.0",
        "scene.toml: openings.top: give flow [m^3/s] or pressure [Pa], not both",
    ),
    "flow through a capped opening": (
        'state = "open"',
        'state = "capped"\nflow = 1e-5',
        "scene.toml: openings.top: a capped opening has no flow and no pressure; "
        "set state = 'open'",
    ),
    "pressure at a capped opening": (
        'state = "open"',
        'state = "capped"\npressure = 0.0',
        "scene.toml: openings.top: a capped opening has no flow and no pressure; "
        "set state = 'open'",
    ),
    "waveform of nothing": (
        'state = "open"',
        'waveform = "common_carotid"',
        "scene.toml: openings.top: a waveform needs a flow [m^3/s] or a pressure [Pa] to multiply",
    ),
    "flow with its unit": (
        'state = "open"',
        'flow = "20 ml/s"',
        "scene.toml: openings.top.flow: found '20 ml/s'; expected float | null",
    ),
    "endless pressure": (
        'state = "open"',
        "pressure = -inf",
        "scene.toml: openings.top.pressure: found -inf; expected float > -1000000000000.0",
    ),
    "waveform by a number": (
        'state = "open"',
        "flow = 1e-5\nwaveform = 3",
        "scene.toml: openings.top.waveform: found 3; expected str | null",
    ),
    "unknown key of an opening": (
        'state = "open"',
        "flux = 1e-5",
        "scene.toml: openings.top: unknown key flux; allowed: centre, state, flow, pressure, "
        "waveform",
    ),
    "tool without a place": (
        "[column]",
        '[tool]\nsurface = "needle.stl"\n\n[column]',
        "scene.toml: tool: the key position is missing",
    ),
    "tool without a surface": (
        "[column]",
        "[tool]\nposition = [0.0, 0.0, 0.0]\n\n[column]",
        "scene.toml: tool: the key surface is missing",
    ),
    "tool in two dimensions": (
        "[column]",
        '[tool]\nsurface = "needle.stl"\nposition = [0.0, 0.0]\n\n[column]',
        "scene.toml: tool.position: found [0.0, 0.0]; expected array of length 3",
    ),
    "tool of no size": (
        "[column]",
        '[tool]\nsurface = "needle.stl"\nposition = [0.0, 0.0, 0.0]\nscale = 0\n\n[column]',
        "scene.toml: tool.scale: found 0; expected float > 0.0",
    ),
    "unknown key of the tool": (
        "[column]",
        '[tool]\nsurface = "needle.stl"\nposition = [0.0, 0.0, 0.0]\nspeed = 1.0\n\n[column]',
        "scene.toml: tool: unknown key speed; allowed: surface, position, scale",
    ),
    "tool by its name": (
        "[vessel]",
        'tool = "needle"\n\n[vessel]',
        "scene.toml: tool: found 'needle'; expected object | null",
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


def test_an_opening_is_driven_by_a_flow_or_a_pressure_and_by_nothing_else():
    still = parse(GOOD).openings["top"]
    assert (still.driven, still.flow, still.pressure, still.waveform) == (False, None, None, None)
    pump = parse(GOOD.replace('state = "open"', 'flow = -2e-5\nwaveform = "beat.csv"'))
    top = pump.openings["top"]
    assert (top.driven, top.flow, top.pressure, top.waveform) == (True, -2e-5, None, "beat.csv")
    assert top.state == "open"
    # A reservoir at the pressure outside still drives: blood may come back from it.
    reservoir = parse(GOOD.replace('state = "open"', "pressure = 0")).openings["top"]
    assert (reservoir.driven, reservoir.flow, reservoir.pressure) == (True, None, 0.0)


def test_a_column_may_fill_the_whole_lumen():
    column = parse(GOOD.replace("height = 0.01", "full = true")).column
    assert (column.full, column.height, column.particles) == (True, None, None)
    assert not parse(GOOD).column.full


def test_a_tool_is_a_surface_at_a_place():
    assert parse(GOOD).tool is None
    table = '[tool]\nsurface = "needle.stl"\nposition = [0.0, 0.01, -0.02]\n\n[column]'
    tool = parse(GOOD.replace("[column]", table)).tool
    assert tool == ToolTable(surface="needle.stl", position=(0.0, 0.01, -0.02), scale=1.0)


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
