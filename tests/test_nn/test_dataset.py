import multiprocessing
import os
import resource
import signal
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from nn import dataset
from nn.dataset import Dataset, Proxies, RecordedState, RunMetadata, RunWriter, Substeps, check
from taichi_sph.errors import InputError

SCENE = """
title = "A tank"
duration = 0.5
frame_interval = 0.002
gravity = [0.0, 0.0, -9.81]
vessel = { surface = "lumen.ply" }
column = { opening = "top", particles = 9 }
discretization = { spacing = 0.001 }
"""
FACTS = RunMetadata(
    scene=SCENE,
    scene_name="tank",
    scene_folder="/vessels/tank",
    surface_sha256="0" * 64,
    program_version="0.1.0",
    architecture="cpu",
    seed=3,
    height=0.004,
    frames=6,
    particles=50,
    spacing=1e-3,
    support_radius=2e-3,
    sound_speed=6.0,
    substep=5e-5,
    substeps=4,
    frame_interval=2e-4,
    feature_version=0,
)
WALL = Proxies(
    np.linspace(0.0, 1.0, 21, dtype=np.float32).reshape(7, 3),
    np.tile(np.array([0.0, 0.0, 1.0], np.float32), (7, 1)),
    np.full(7, 1e-9, np.float32),
)
FEATURES = 23


def states(facts: RunMetadata) -> list[RecordedState]:
    """Blood of which ten particles leave after every second frame."""
    random = np.random.default_rng(facts.seed)
    alive = np.ones(facts.particles, bool)
    made = []
    for frame in range(facts.frames + 1):
        if frame and frame % 2 == 0:
            alive[np.flatnonzero(alive)[:10]] = False
        position, velocity = random.normal(size=(2, facts.particles, 3)).astype(np.float32)
        position[~alive] = velocity[~alive] = 0.0
        made.append(RecordedState(position, velocity, alive.copy()))
    return made


def write(writer: RunWriter, made: list[RecordedState], width: int, upto: int) -> None:
    """Append states from where the writer is up to a number of them."""
    interval = writer.facts.frame_interval
    for frame in range(writer.committed, upto):
        state = made[frame]
        acceleration = np.zeros_like(state.velocity)
        if frame:
            before = made[frame - 1].velocity
            acceleration = dataset.mean_acceleration(before, state.velocity, state.alive, interval)
        features = None
        if width and frame < writer.facts.frames:
            features = np.full((len(state.alive), width), frame, np.float32)
            features[~state.alive] = 0.0
        writer.append(state, acceleration, features, Substeps(4 + frame % 2, 4e-5, 5e-5))


def make(
    path: Path, facts: tuple[RunMetadata, ...] = (FACTS,), width: int = 0
) -> list[list[RecordedState]]:
    """A dataset of made-up runs."""
    parts, everything = [], []
    for number, one in enumerate(facts):
        part = path.with_name(f"{path.name}.{number}")
        made = states(one)
        with RunWriter(part, one, WALL, width) as writer:
            write(writer, made, width, one.frames + 1)
        parts.append(part)
        everything.append(made)
    dataset.merge(parts, path)
    assert not any(part.exists() for part in parts)
    return everything


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "data.h5"


@pytest.fixture(params=[0, FEATURES], ids=["plain", "with features"])
def width(request: pytest.FixtureRequest) -> int:
    return request.param


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
    assert (scene.title, scene.name, scene.folder) == ("A tank", "tank", "/vessels/tank")
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


def test_a_run_with_no_sub_step_at_all_can_be_kept(path: Path) -> None:
    facts = replace(FACTS, frames=1, particles=3)
    with RunWriter(path.with_name("part"), facts, WALL) as writer:
        gone = RecordedState(np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3, bool))
        for _ in range(2):
            writer.append(gone, np.zeros((3, 3)), None, Substeps())
    dataset.merge([path.with_name("part")], path)
    check(path)


def test_a_run_goes_on_where_it_was_left(path: Path, width: int) -> None:
    made = make(path, (FACTS,), width)[0]
    part = path.with_name("part")
    for upto in (2, 3, FACTS.frames + 1):
        with RunWriter(part, FACTS, WALL, width) as writer:
            write(writer, made, width, upto)
            assert writer.steps() == sum(4 + f % 2 for f in range(1, upto))
            np.testing.assert_array_equal(writer.state(1).velocity, made[1].velocity)
        assert dataset.committed_states(part, FACTS) == upto
    again = path.with_name("again.h5")
    dataset.merge([part], again)
    assert again.read_bytes() == path.read_bytes()


def append_and_wait(part: Path, ready: Any) -> None:
    """Commit three states, write two more, and be killed."""
    dataset.COMMIT_EVERY = 0.0
    writer = RunWriter(part, FACTS, WALL)
    write(writer, states(FACTS), 0, 3)
    dataset.COMMIT_EVERY = 1e9
    write(writer, states(FACTS), 0, 5)
    ready.set()
    signal.pause()


def test_a_killed_writer_leaves_what_it_had_committed(path: Path) -> None:
    make(path)
    part = path.with_name("part")
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    process = context.Process(target=append_and_wait, args=(part, ready), daemon=True)
    process.start()
    assert ready.wait(60.0)
    with pytest.raises(InputError, match="another process is writing it"):
        RunWriter(part, FACTS, WALL)
    os.kill(process.pid or 0, signal.SIGKILL)
    process.join()
    made = states(FACTS)
    with RunWriter(part, FACTS, WALL) as writer:
        assert writer.committed == 3
        np.testing.assert_array_equal(writer.state(2).position, made[2].position)
        write(writer, made, 0, FACTS.frames + 1)
    again = path.with_name("again.h5")
    dataset.merge([part], again)
    assert again.read_bytes() == path.read_bytes()


def test_a_layout_killed_half_way_is_begun_again(path: Path) -> None:
    part = path.with_name("part")
    part.with_name("part.new").write_bytes(dataset.SIGNATURE + b"half")
    with RunWriter(part, FACTS, WALL) as writer:
        assert writer.committed == 0
    assert not part.with_name("part.new").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": 7}, "holds a run of frames 6, asked for is 7"),
        ({"height": 0.003}, "holds a run of height 0.004, asked for is 0.003"),
        ({"scene": SCENE + "# changed"}, "holds a run of another scene"),
    ],
)
def test_a_run_under_way_is_not_mistaken_for_another(
    path: Path, change: dict[str, Any], message: str
) -> None:
    with RunWriter(path, FACTS, WALL) as writer:
        write(writer, states(FACTS), 0, 2)
    with pytest.raises(InputError, match=message):
        RunWriter(path, replace(FACTS, **change), WALL)
    with pytest.raises(InputError, match=message):
        dataset.committed_states(path, replace(FACTS, **change))
    with pytest.raises(InputError, match="another wall"):
        RunWriter(path, FACTS, replace(WALL, volume=2.0 * WALL.volume))


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
        RunWriter(path, FACTS, WALL).close()
    elif kind != "missing":
        with h5py.File(path, "w") as file:
            if kind != "other":
                file.attrs["format"] = dataset.DATASET
                file.attrs["schema"] = 2 if kind == "newer" else dataset.SCHEMA
                file.attrs["complete"] = kind != "unfinished"


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("missing", "there is no such file"),
        ("folder", "there is no such file"),
        ("text", "the file is no HDF5; a dataset is what `vesselflow record` writes"),
        ("other", "an HDF5 file of another program"),
        ("part", "a run that is not finished"),
        ("newer", "schema 2, but this program reads schema 1"),
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


def test_only_finished_runs_are_merged_and_the_others_stay(path: Path) -> None:
    part = path.with_name("part")
    with RunWriter(part, FACTS, WALL) as writer:
        write(writer, states(FACTS), 0, 3)
    with pytest.raises(InputError, match="the run is not finished"):
        dataset.merge([part], path)
    assert part.exists()
    assert not path.exists()


STREAM = """
import resource, sys
from pathlib import Path
import numpy as np
from test_dataset import FACTS, WALL, dataset, replace, RunWriter, RecordedState, Substeps
facts = replace(FACTS, frames=60, particles=20000)
part, out = Path("part"), Path("data.h5")
state = RecordedState(*np.zeros((2, 20000, 3), np.float32), np.ones(20000, bool))
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
def stream(path, frames, out):
    facts = replace(FACTS, frames=frames, particles=20000)
    with RunWriter(path, facts, WALL) as writer:
        for _ in range(frames + 1):
            writer.append(state, state.velocity, None, Substeps(1, 1.0, 1.0))
    dataset.merge([path], out)
    dataset.check(out)
stream(Path("few"), 2, Path("few.h5"))
before = peak()
stream(Path("many"), 60, Path("many.h5"))
print(peak() - before, dataset.size_of(facts, 0) / 2**20)
"""


def test_memory_does_not_grow_with_the_frames(tmp_path: Path) -> None:
    paths = os.pathsep.join(p for p in sys.path if p)
    grown, written = subprocess.run(
        [sys.executable, "-c", STREAM],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": paths},
        capture_output=True, text=True, check=True,
    ).stdout.split()  # fmt: skip
    assert float(written) > 40.0
    assert float(grown) < 4.0, "[MB], for sixty frames of 0.7 MB"


def test_a_disk_without_room_is_found_before_anything_is_written(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part = path.with_name("part")
    facts = replace(FACTS, frames=1)
    with RunWriter(part, facts, WALL) as writer:
        write(writer, states(facts), 0, 2)
    full = os.statvfs_result((4096, 4096, 9, 2, 2, 9, 9, 9, 0, 255))
    monkeypatch.setattr(os, "statvfs", lambda _: full)
    for begin in (lambda: dataset.merge([part], path), lambda: RunWriter(path, FACTS, WALL)):
        with pytest.raises(OSError, match="No space left on device") as caught:
            begin()
        assert caught.value.filename.startswith(str(path))
    assert list(path.parent.iterdir()) == [part]


def test_a_write_that_fails_names_the_file_and_the_reason(path: Path) -> None:
    facts = replace(FACTS, particles=5000)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    with RunWriter(path, facts, WALL) as writer:
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, before[1]))
            with pytest.raises(OSError, match="File too large") as caught:
                write(writer, states(facts), 0, 1)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert caught.value.filename == str(path)
        assert writer.committed == 0
        write(writer, states(facts), 0, 2)
        assert path.read_bytes()[:8] == dataset.SIGNATURE
    assert dataset.committed_states(path, facts) == 2
