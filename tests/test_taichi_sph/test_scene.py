import os
from pathlib import Path
from typing import Literal

import msgspec
import pytest

from taichi_sph.errors import InputError
from taichi_sph.scene import (
    CassonTable,
    NewtonianTable,
    ToolTable,
    _plain,
    parse_scene,
    read_scene,
)

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

# What is written, what it is replaced by; the place and what else the sentence says.
MISTAKES = {
    "unknown key in a table": (
        "spacing = 1e-3",
        "spacing = 1e-3\nsupport = 2.0",
        "discretization",
        "unknown key support",
    ),
    "unknown key at the top": (
        "duration = 0.1",
        "duration = 0.1\ncolour = 3",
        "",
        "unknown key colour; allowed: title, vessel, ",
    ),
    "unknown table": ("[column]", "[colum]", "", "unknown key colum; allowed: title, vessel, "),
    "key of another law": (
        'model = "casson"',
        'model = "newtonian"\nyield_stress = 3.0',
        "blood.rheology",
        "unknown key yield_stress; allowed: model, viscosity",
    ),
    "key that the reader sets": (
        "duration = 0.1",
        'duration = 0.1\nfolder = "/"',
        "",
        "unknown key folder",
    ),
    "text for a number": (
        "spacing = 1e-3",
        'spacing = "1 mm"',
        "discretization.spacing",
        "found '1 mm'; expected a number",
    ),
    "truth for a number": (
        "spacing = 1e-3",
        "spacing = true",
        "discretization.spacing",
        "found True; expected a number",
    ),
    "half a particle": (
        "height = 0.01",
        "particles = 1.5",
        "column.particles",
        "found 1.5; expected a whole number",
    ),
    "two components": (
        "gravity = [0.0, 0.0, -9.81]",
        "gravity = [0.0, -9.81]",
        "gravity",
        "found [0.0, -9.81]; expected a list of length 3",
    ),
    "negative density": (
        "density = 1060.0",
        "density = -1060.0",
        "blood.density",
        "found -1060.0; expected a number > 0.0",
    ),
    "spacing that is no number": (
        "spacing = 1e-3",
        "spacing = nan",
        "discretization.spacing",
        "found nan; expected a number > 0.0",
    ),
    "no particles": (
        "height = 0.01",
        "particles = 0",
        "column.particles",
        "found 0; expected a whole number >= 1",
    ),
    "support too wide": (
        "spacing = 1e-3",
        "spacing = 1e-3\nsupport_ratio = 5.0",
        "discretization.support_ratio",
        "found 5.0; expected a number <= 4.0",
    ),
    "endless run": (
        "duration = 0.1",
        "duration = inf",
        "duration",
        "found inf; expected a number < 1000000000000.0",
    ),
    "gravity of a star": (
        "gravity = [0.0, 0.0, -9.81]",
        "gravity = [0.0, 0.0, -9.81e9]",
        "gravity",
        "(0.0, 0.0, -9810000000.0) m/s^2 is not a plausible body force",
    ),
    "missing key": ("spacing = 1e-3", "", "discretization", "the key spacing is missing"),
    "missing key at the top": ("duration = 0.1", "", "", "the key duration is missing"),
    "neither height nor particles": (
        "height = 0.01",
        "",
        "column",
        "give height [m], particles or full = true, one of the three",
    ),
    "height and particles": (
        "height = 0.01",
        "height = 0.01\nparticles = 100",
        "column",
        "give height [m], particles or full = true, one of the three",
    ),
    "height and full": (
        "height = 0.01",
        "height = 0.01\nfull = true",
        "column",
        "give height [m], particles or full = true, one of the three",
    ),
    "not full": (
        "height = 0.01",
        "full = false",
        "column",
        "give height [m], particles or full = true, one of the three",
    ),
    "full below an offset": (
        "height = 0.01",
        "full = true\noffset = 0.002",
        "column",
        "an offset [m] leaves no full lumen",
    ),
    "full of text": (
        "height = 0.01",
        'full = "yes"',
        "column.full",
        "found 'yes'; expected true or false",
    ),
    "flow and pressure": (
        'state = "open"',
        "flow = 1e-5\npressure = 0.0",
        "openings.top",
        "give flow [m^3/s] or pressure [Pa], not both",
    ),
    "flow through a capped opening": (
        'state = "open"',
        'state = "capped"\nflow = 1e-5',
        "openings.top",
        "a capped opening has no flow and no pressure; set state = 'open'",
    ),
    "pressure at a capped opening": (
        'state = "open"',
        'state = "capped"\npressure = 0.0',
        "openings.top",
        "a capped opening has no flow and no pressure; set state = 'open'",
    ),
    "waveform of nothing": (
        'state = "open"',
        'waveform = "common_carotid"',
        "openings.top",
        "a waveform needs a flow [m^3/s] or a pressure [Pa]",
    ),
    "flow with its unit": (
        'state = "open"',
        'flow = "20 ml/s"',
        "openings.top.flow",
        "found '20 ml/s'; expected a number",
    ),
    "endless pressure": (
        'state = "open"',
        "pressure = -inf",
        "openings.top.pressure",
        "found -inf; expected a number > -1000000000000.0",
    ),
    "waveform by a number": (
        'state = "open"',
        "flow = 1e-5\nwaveform = 3",
        "openings.top.waveform",
        "found 3; expected text",
    ),
    "unknown key of an opening": (
        'state = "open"',
        "flux = 1e-5",
        "openings.top",
        "unknown key flux; allowed: centre, state, flow, pressure, waveform",
    ),
    "tool without a place": (
        "[column]",
        '[tool]\nsurface = "needle.stl"\n\n[column]',
        "tool",
        "the key position is missing",
    ),
    "tool without a surface": (
        "[column]",
        "[tool]\nposition = [0.0, 0.0, 0.0]\n\n[column]",
        "tool",
        "the key surface is missing",
    ),
    "tool in two dimensions": (
        "[column]",
        '[tool]\nsurface = "needle.stl"\nposition = [0.0, 0.0]\n\n[column]',
        "tool.position",
        "found [0.0, 0.0]; expected a list of length 3",
    ),
    "tool of no size": (
        "[column]",
        '[tool]\nsurface = "needle.stl"\nposition = [0.0, 0.0, 0.0]\nscale = 0\n\n[column]',
        "tool.scale",
        "found 0; expected a number > 0.0",
    ),
    "unknown key of the tool": (
        "[column]",
        '[tool]\nsurface = "needle.stl"\nposition = [0.0, 0.0, 0.0]\nspeed = 1.0\n\n[column]',
        "tool",
        "unknown key speed; allowed: surface, position, scale",
    ),
    "tool by its name": (
        "[vessel]",
        'tool = "needle"\n\n[vessel]',
        "tool",
        "found 'needle'; expected a table",
    ),
    "opening that is not there": (
        'opening = "top"',
        'opening = "bottom"',
        "column.opening",
        "'bottom' is not an opening; allowed: top",
    ),
    "opening neither open nor capped": (
        'state = "open"',
        'state = "ajar"',
        "openings.top.state",
        "found 'ajar'; allowed: capped, open",
    ),
    "infinite spacing": (
        "spacing = 1e-3",
        "spacing = inf",
        "discretization.spacing",
        "found inf; expected a number < 1000000000000.0",
    ),
    "law that is not there": (
        'model = "casson"',
        'model = "carreau"',
        "blood.rheology.model",
        "found 'carreau'; allowed: newtonian, casson",
    ),
    "no TOML": (
        'title = "Tube"',
        "title = Tube",
        "",
        "not a TOML file: Invalid value (at line 2, column 9)",
    ),
}


def parse(text: str):
    return parse_scene(text, "scene.toml", Path("/somewhere"), "tube")


def complaint(written: str, instead: str) -> str:
    assert GOOD.count(written) == 1
    with pytest.raises(InputError) as error:
        parse(GOOD.replace(written, instead))
    return str(error.value)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_told_with_its_place_and_what_is_allowed(mistake):
    written, instead, place, *parts = MISTAKES[mistake]
    said = complaint(written, instead)
    assert said.startswith(f"scene.toml: {place}: " if place else "scene.toml: ")
    for part in parts:
        assert part in said
    assert "\n" not in said


def test_a_mistake_is_one_sentence():
    assert complaint("spacing = 1e-3", "spacing = 1e-3\nsupport = 2.0") == (
        "scene.toml: discretization: unknown key support; allowed: spacing, support_ratio, "
        "wall_spacing_ratio, sound_speed_ratio, courant_number, integrator, viscous_form"
    )
    assert complaint("density = 1060.0", "density = -1060.0") == (
        "scene.toml: blood.density: found -1060.0; expected a number > 0.0"
    )


def test_what_is_allowed_is_that_of_the_own_table():
    class Pump(msgspec.Struct):
        mode: Literal["steady", "pulsed"]

    class Wall(msgspec.Struct):
        mode: Literal["rigid", "elastic"]

    class Both(msgspec.Struct):
        pump: Pump
        wall: Wall

    table = {"pump": {"mode": "steady"}, "wall": {"mode": "soft"}}
    with pytest.raises(msgspec.ValidationError) as error:
        msgspec.convert(table, Both)
    said = _plain(error.value, Both, table)
    assert said == "wall.mode: found 'soft'; allowed: elastic, rigid"
    assert "openings.a.b.state: found 'ajar'; allowed: capped, open" in complaint(
        "[column]", '[openings."a.b"]\ncentre = [0.0, 0.0, 0.0]\nstate = "ajar"\n\n[column]'
    )


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


def test_a_scene_has_the_name_of_its_folder_however_that_is_given(tmp_path, monkeypatch):
    folder = tmp_path / "my vessel"
    folder.mkdir()
    (folder / "scene.toml").write_text(GOOD)
    (tmp_path / "a link").symlink_to(folder)
    monkeypatch.chdir(folder)
    (folder / "below").mkdir()
    for given in ("scene.toml", "./scene.toml", "below/../scene.toml", str(folder / "scene.toml")):
        assert read_scene(Path(given)).name == "my vessel"
    assert read_scene(Path("../a link/scene.toml")).name == "a link"


def test_a_name_that_is_no_text_can_be_shown_and_recorded(tmp_path):
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    try:
        folder.mkdir()
    except OSError:
        pytest.skip("this file system takes UTF-8 alone")
    (folder / "scene.toml").write_text(GOOD)
    assert read_scene(folder / "scene.toml").name.encode() == b"caf\xef\xbf\xbd"


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
