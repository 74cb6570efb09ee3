from pathlib import Path

import msgspec
import pytest

from taichi_sph.errors import InputError
from taichi_sph.scene import read_scene
from taichi_sph.scene_files import changed_file, found_in, scene_files

SCENE = """
title = "Tube"
duration = 0.1
frame_interval = 0.01
gravity = [0.0, 0.0, -9.81]
[vessel]
surface = "wall.stl"
[openings.top]
centre = [0.0, 0.0, 1.0]
flow = 1e-6
waveform = "beats/beat.csv"
[openings.bottom]
centre = [0.0, 0.0, 0.0]
flow = 1e-6
waveform = "common_carotid"
[column]
opening = "top"
height = 0.01
[wall]
pulse = 1e-4
waveform = "pulse.csv"
[tool]
surface = "probe.stl"
position = [0.0, 0.0, 0.0]
[discretization]
spacing = 1e-3
"""
FILES = {
    "surface wall.stl", "tool probe.stl", "waveform beats/beat.csv", "waveform pulse.csv",
}  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "tube"
    (folder / "beats").mkdir(parents=True)
    (folder / "scene.toml").write_text(SCENE)
    for named in FILES:
        (folder / named.split()[1]).write_text(named)
    return folder


def test_every_file_that_a_scene_names_is_known(folder: Path) -> None:
    files = scene_files(read_scene(folder / "scene.toml"))
    assert set(files) == FILES
    assert len(set(files.values())) == len(FILES)


@pytest.mark.parametrize("named", sorted(FILES))
def test_a_file_that_changes_is_named(folder: Path, named: str) -> None:
    scene = read_scene(folder / "scene.toml")
    before = scene_files(scene)
    assert changed_file(before, scene_files(scene)) is None
    (folder / named.split()[1]).write_text("another")
    assert changed_file(before, scene_files(scene)) == named
    (folder / named.split()[1]).unlink()
    assert changed_file(before, scene_files(scene)) == named


def test_what_is_moved_is_found_and_what_has_changed_is_refused(folder: Path) -> None:
    scene = read_scene(folder / "scene.toml")
    files = scene_files(scene)
    moved = folder.rename(folder.with_name("elsewhere"))
    assert found_in(scene, files, [folder, moved]).folder == str(moved)
    with pytest.raises(InputError, match=r"^tube: its .* is not there"):
        found_in(scene, files, [folder])
    (moved / "wall.stl").write_text("another")
    with pytest.raises(InputError, match=r"^tube: its surface wall.stl differs"):
        found_in(scene, files, [folder, moved])


def test_every_key_that_is_called_a_file_is_typed_as_one() -> None:
    """A new key of the scene that names a file must not be forgotten."""
    for table in msgspec.inspect.multi_type_info(
        [t for t in _tables() if issubclass(t, msgspec.Struct)]
    ):
        for field in table.fields:  # type: ignore[attr-defined]
            if field.name in ("surface", "waveform") or "file" in field.name:
                assert isinstance(field.type, msgspec.inspect.Metadata), field.name


def _tables() -> list[type]:
    import taichi_sph.scene as module

    return [value for value in vars(module).values() if isinstance(value, type)]
