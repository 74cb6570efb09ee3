"""Datasets, read: what is in them, and what is refused."""

import os
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from dataset_runs import FACTS, FEATURES, FILES, WALL, make
from nn.dataset.reader import Dataset, check
from nn.dataset.schema import DATASET, SCHEMA, Substeps
from nn.dataset.writer import RunWriter
from taichi_sph.errors import InputError


def test_what_is_written_is_read(path: Path, width: int) -> None:
    second = replace(FACTS, height=0.005, particles=30, frames=4, seed=4)
    made = make(path, (FACTS, second), width)
    with Dataset(path) as data:
        assert [run.name for run in data.runs] == ["0", "1"]
        assert [run.facts for run in data.runs] == [FACTS, second]
        for run, expected in zip(data.runs, made, strict=True):
            for frame, state in enumerate(expected):
                np.testing.assert_array_equal(run.position(frame), state.position)
                np.testing.assert_array_equal(run.velocity(frame), state.velocity)
                np.testing.assert_array_equal(run.alive(frame), state.alive)
            np.testing.assert_array_equal(
                run.velocity(slice(None)), np.stack([state.velocity for state in expected])
            )
            for name, value in asdict(run.proxies()).items():
                np.testing.assert_array_equal(value, asdict(WALL)[name])
            assert run.substeps(1) == Substeps(4, 4e-5, 5e-5)
            assert run.has_features == bool(width)
            if width:
                assert (run.features(2)[run.alive(2)] == 2.0).all()
    check(path)


def test_the_scene_comes_back_with_the_column_of_the_run(path: Path) -> None:
    make(path)
    with Dataset(path) as data:
        scene = data.runs[0].scene
        surface = (Path(scene.folder) / scene.vessel.surface).read_bytes()
    assert (scene.title, scene.name, surface) == ("A tank", "tank", FILES["lumen.ply"])
    assert not Path(scene.folder).exists(), "files last as long as the dataset is open"
    assert (scene.column.height, scene.column.particles) == (0.004, None)


def test_target_and_acceleration_are_the_change_of_velocity_after_and_before(
    path: Path, width: int
) -> None:
    (made,) = make(path, (FACTS,), width)
    with Dataset(path) as data:
        (run,) = data.runs
        assert len(run) == FACTS.frames
        velocity = np.stack([state.velocity for state in made]).astype(np.float64)
        alive = np.stack([state.alive for state in made])
        for frame in range(len(run)):
            after = (velocity[frame + 1] - velocity[frame]) / FACTS.frame_interval
            stays = alive[frame + 1]
            np.testing.assert_allclose(run.target(frame)[stays], after[stays], rtol=1e-6)
            np.testing.assert_array_equal(run.has_target(frame), stays)
            assert not run.target(frame)[~stays].any()
            if frame:
                np.testing.assert_array_equal(run.acceleration(frame), run.target(frame - 1))
        assert not run.acceleration(0).any()
        assert not alive[-1].all(), "some must have left for this to mean anything"


def test_every_dataset_has_a_unit_and_frames_are_chunks_with_checksums(path: Path) -> None:
    make(path, (FACTS,), FEATURES)
    with h5py.File(path) as file:
        group = file["runs/0"]
        units = {name: data.attrs["unit"] for name, data in group.items()}
        assert units["velocity"] == "m/s"
        assert units["target"] == "m/s^2"
        assert units["proxy_volume"] == "m^3"
        for name in ("position", "velocity", "acceleration", "features", "target", "alive"):
            data = group[name]
            assert data.chunks == (1, *data.shape[1:])
            assert data.fletcher32
            assert data.compression == "gzip"
        assert group["features"].shape == (6, 50, 23)
        attributes = dict(group.attrs)
    assert attributes["frame_interval"] == FACTS.frame_interval
    assert attributes["frame_interval_unit"] == "s"
    assert attributes["substep_smallest"] == 4e-5
    assert attributes["substeps_taken"] == 5 + 4 + 5 + 4 + 5 + 4
    assert attributes["substeps_most"] == 5


@pytest.mark.parametrize("share", [0.0, 0.001, 0.1, 0.5, 0.999])
def test_a_cut_file_says_so(path: Path, share: float) -> None:
    make(path)
    os.truncate(path, int(share * path.stat().st_size))
    with pytest.raises(InputError, match=r"the file is (cut|empty|no HDF5)") as caught:
        Dataset(path)
    assert str(caught.value).startswith(f"{path}: ")


def foreign(path: Path, kind: str) -> None:
    """Write something that is no dataset."""
    if kind == "text":
        path.write_text("time,position\n0,1\n")
    elif kind == "folder":
        path.mkdir()
    elif kind == "part":
        RunWriter(path, FACTS, WALL, FILES).close()
    elif kind != "missing":
        with h5py.File(path, "w") as file:
            if kind != "other":
                file.attrs["format"] = DATASET
                file.attrs["schema"] = 9 if kind == "newer" else SCHEMA
                file.attrs["complete"] = kind != "unfinished"
                file.create_group("files")


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("missing", "there is no such file"),
        ("folder", "there is no such file"),
        ("text", "the file is no HDF5; a dataset is what `vesselflow record` writes"),
        ("other", "an HDF5 file of another program"),
        ("part", "a run that is not finished"),
        ("newer", "schema 9, but this program reads 1 and 2"),
        ("unfinished", "the dataset is not finished"),
        ("empty", "the dataset has no runs"),
    ],
)
def test_a_foreign_file_is_refused(path: Path, kind: str, message: str) -> None:
    foreign(path, kind)
    with pytest.raises(InputError, match=message):
        Dataset(path)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda g: g.pop("velocity"), "runs/0: has no velocity"),
        (lambda g: g.attrs.pop("sound_speed"), "runs/0: the attribute sound_speed is missing"),
        (lambda g: g["position"].attrs.modify("unit", "mm"), r"runs/0/position: .*\[mm\]"),
        (lambda g: g.attrs.modify("frames", 9), r"runs/0/\w+: is \(\d+, 50, 3\)"),
        (lambda g: g.attrs.modify("frame_interval", 1.0), "target: frame 1 is not the change"),
        (lambda g: set_entry(g, "velocity", (2, 0, 0), 5.0), "velocity: frame 2 moves a particle"),
        (lambda g: set_entry(g, "velocity", (1, 30, 0), np.nan), "frame 1 .* not finite"),
        (lambda g: set_entry(g, "acceleration", (2, 30, 1), 7.0), "target: frame 2 is not the"),
        (lambda g: set_entry(g, "acceleration", (0, 30, 1), 7.0), "acceleration: frame 0 is not"),
        (lambda g: set_entry(g, "alive", (3, 0), 1), "alive: frame 3 brings back a particle"),
    ],
)  # fmt: skip
def test_a_broken_promise_is_found(path: Path, damage: Any, message: str) -> None:
    make(path)
    with h5py.File(path, "r+") as file:
        damage(file["runs/0"])
    with pytest.raises(InputError, match=message):
        check(path)


def set_entry(group: h5py.Group, name: str, place: tuple[int, ...], value: float) -> None:
    group[name][place] = value


def test_a_flipped_bit_is_found_where_it_is(path: Path) -> None:
    make(path)
    with h5py.File(path) as file:
        chunk = file["runs/0/position"].id.get_chunk_info(4)
    raw = bytearray(path.read_bytes())
    raw[chunk.byte_offset + chunk.size // 2] ^= 1
    path.write_bytes(raw)
    with Dataset(path) as data:
        data.runs[0].position(3)
        with pytest.raises(InputError, match="runs/0/position: damaged in frame 4"):
            data.runs[0].position(4)


def test_frames_that_are_not_there_are_no_frames(path: Path) -> None:
    make(path)
    with Dataset(path) as data:
        run = data.runs[0]
        assert run.velocity(len(run)).shape == (50, 3)
        for frame, read in ((len(run) + 1, run.velocity), (len(run), run.target), (-1, run.alive)):
            with pytest.raises(IndexError):
                read(frame)
        with pytest.raises(InputError, match="record with --features"):
            run.features(0)


def test_runs_are_held_out_whole(path: Path) -> None:
    make(path, tuple(replace(FACTS, height=h, frames=1) for h in (0.003, 0.004, 0.005)))
    with Dataset(path) as data:
        train, held_out = data.split([1])
        assert [run.facts.height for run in train] == [0.003, 0.005]
        assert [run.facts.height for run in held_out] == [0.004]
        with pytest.raises(InputError, match="has no run 3 to hold out; allowed are 0 to 2"):
            data.split([3])
        with pytest.raises(InputError, match="all 3 runs are held out"):
            data.split([0, 1, 2])


def to_schema_1(path: Path) -> None:
    """Make of a dataset what it was before it held the files of its scene."""
    with h5py.File(path, "r+") as file:
        del file["files"]
        file.attrs["schema"] = 1
        for run in file["runs"].values():
            del run.attrs["tool_sha256"]


@pytest.mark.parametrize("place", ["tank", "."])
def test_a_dataset_of_schema_1_finds_its_surface_beside_it(path: Path, place: str) -> None:
    make(path)
    to_schema_1(path)
    check(path)
    folder = path.parent / place
    folder.mkdir(exist_ok=True)
    with Dataset(path) as data:
        with pytest.raises(InputError, match=r"lumen\.ply of its scene is not in it, as it is of"):
            _ = data.runs[0].scene
        (folder / "lumen.ply").write_bytes(FILES["lumen.ply"])
        scene = data.runs[0].scene
        assert (Path(scene.folder) / scene.vessel.surface).read_bytes() == FILES["lumen.ply"]
        (folder / "lumen.ply").write_bytes(b"another surface")
        with pytest.raises(InputError, match=r"its surface differs: .*lumen\.ply is not what was"):
            _ = data.runs[0].scene


def test_a_surface_that_was_changed_in_place_is_refused_and_another_vessels_is_not(
    path: Path, tmp_path: Path
) -> None:
    place = tmp_path / "vessels" / "tank"
    place.mkdir(parents=True)
    make(path, (replace(FACTS, scene_folder=str(place)),))
    (path.parent / "lumen.ply").write_bytes(b"of another vessel, in the folder of all data")
    with Dataset(path) as data:
        _ = data.runs[0].scene
        (place / "lumen.ply").write_bytes(b"changed")
        with pytest.raises(InputError, match="its surface differs"):
            _ = data.runs[0].scene
        (place / "lumen.ply").write_bytes(FILES["lumen.ply"])
        _ = data.runs[0].scene
