"""Runs under way, killed or not, and the datasets made of them."""

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dataset_runs import FACTS, FILES, SCENE, WALL, make, states, write
from nn.dataset.reader import check
from nn.dataset.schema import SIGNATURE, UNDER_WAY, RecordedState, Substeps
from nn.dataset.writer import RunWriter, committed_states, merge, record_type
from taichi_sph.errors import InputError


def test_a_run_with_no_sub_step_at_all_can_be_kept(path: Path) -> None:
    facts = replace(FACTS, frames=1, particles=3)
    with RunWriter(path.with_name("part"), facts, WALL, FILES) as writer:
        gone = RecordedState(np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3, bool))
        for _ in range(2):
            writer.append(gone, np.zeros((3, 3)), None, Substeps())
    merge([path.with_name("part")], path)
    check(path)


def test_a_run_goes_on_where_it_was_left(path: Path, width: int) -> None:
    made = make(path, (FACTS,), width)[0]
    part = path.with_name("part")
    for upto in (2, 3, FACTS.frames + 1):
        with RunWriter(part, FACTS, WALL, FILES, width) as writer:
            write(writer, made, width, upto)
            assert writer.steps() == sum(4 + f % 2 for f in range(1, upto))
            np.testing.assert_array_equal(writer.state(1).velocity, made[1].velocity)
        assert committed_states(part, FACTS) == upto
    again = path.with_name("again.h5")
    merge([part], again)
    assert again.read_bytes() == path.read_bytes()


def append_and_wait(part: Path, ready: Any) -> None:
    """Write three states and half of the fourth, and be killed."""
    writer = RunWriter(part, FACTS, WALL, FILES)
    write(writer, states(FACTS), 0, 3)
    whole = record_type(FACTS.particles, 0).itemsize
    with part.open("ab") as file:
        file.write(b"x" * (whole // 2))
    ready.set()
    signal.pause()


def test_a_killed_writer_leaves_all_that_was_whole(path: Path) -> None:
    make(path)
    part = path.with_name("part")
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    process = context.Process(target=append_and_wait, args=(part, ready), daemon=True)
    process.start()
    assert ready.wait(60.0)
    with pytest.raises(InputError, match="another process is writing it"):
        RunWriter(part, FACTS, WALL, FILES)
    os.kill(process.pid or 0, signal.SIGKILL)
    process.join()
    made = states(FACTS)
    assert committed_states(part, FACTS) == 3
    with RunWriter(part, FACTS, WALL, FILES) as writer:
        assert writer.states == 3
        np.testing.assert_array_equal(writer.state(2).position, made[2].position)
        write(writer, made, 0, FACTS.frames + 1)
    again = path.with_name("again.h5")
    merge([part], again)
    assert again.read_bytes() == path.read_bytes()


def test_a_record_that_never_reached_the_disk_ends_the_run_there(path: Path) -> None:
    """As a power cut leaves it: the length is there, the bytes are zero."""
    with RunWriter(path, FACTS, WALL, FILES) as writer:
        write(writer, states(FACTS), 0, 5)
    whole, content = record_type(FACTS.particles, 0).itemsize, bytearray(path.read_bytes())
    content[-2 * whole : -whole] = bytes(whole)
    path.write_bytes(content)
    assert committed_states(path, FACTS) == 3
    with pytest.raises(InputError, match="the run is not finished"):
        merge([path], path.with_name("data.h5.new"))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (SIGNATURE + b"half", "no run under way of this program; delete it"),
        (b"", "no run under way of this program; delete it"),
        (UNDER_WAY + b', "schema": 9, "features": 1}\n', "a run under way of schema 9"),
        (UNDER_WAY + b', "sch', "a run under way that is damaged; delete it"),
        (UNDER_WAY + b', "schema": 2, "proxies": 7}\n', "a run under way that is damaged"),
    ],
)
def test_a_file_that_is_no_run_under_way_is_refused(
    path: Path, content: bytes, message: str
) -> None:
    path.write_bytes(content)
    for begin in (
        lambda: RunWriter(path, FACTS, WALL, FILES), lambda: committed_states(path, FACTS)
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            begin()
    assert path.read_bytes() == content


def test_a_layout_killed_half_way_is_begun_again(path: Path) -> None:
    part = path.with_name("part")
    part.with_name("part.new").write_bytes(SIGNATURE + b"half")
    with RunWriter(part, FACTS, WALL, FILES) as writer:
        assert writer.states == 0
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
    with RunWriter(path, FACTS, WALL, FILES) as writer:
        write(writer, states(FACTS), 0, 2)
    with pytest.raises(InputError, match=message):
        RunWriter(path, replace(FACTS, **change), WALL, FILES)
    with pytest.raises(InputError, match=message):
        committed_states(path, replace(FACTS, **change))
    with pytest.raises(InputError, match="another wall"):
        RunWriter(path, FACTS, replace(WALL, volume=2.0 * WALL.volume), FILES)


def test_only_finished_runs_are_merged_and_the_others_stay(path: Path) -> None:
    part = path.with_name("part")
    with RunWriter(part, FACTS, WALL, FILES) as writer:
        write(writer, states(FACTS), 0, 3)
    with pytest.raises(InputError, match="the run is not finished"):
        merge([part], path)
    assert part.exists()
    assert not path.exists()


STREAM = """
from dataclasses import replace
from pathlib import Path
import numpy as np
from dataset_runs import FACTS, FILES, WALL
from nn.dataset.reader import check
from nn.dataset.schema import RecordedState, Substeps, size_of
from nn.dataset.writer import RunWriter, merge
from taichi_sph.system import largest_memory
state = RecordedState(*np.zeros((2, 20000, 3), np.float32), np.ones(20000, bool))
def stream(path, frames, out):
    facts = replace(FACTS, frames=frames, particles=20000)
    with RunWriter(path, facts, WALL, FILES) as writer:
        for _ in range(frames + 1):
            writer.append(state, state.velocity, None, Substeps(1, 1.0, 1.0))
    merge([path], out)
    check(out)
    return size_of(facts, 0)
stream(Path("few"), 2, Path("few.h5"))
before = largest_memory()
written = stream(Path("many"), 60, Path("many.h5"))
print((largest_memory() - before) / 2**20, written / 2**20)
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
    with RunWriter(part, facts, WALL, FILES) as writer:
        write(writer, states(facts), 0, 2)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(9, 1, 8))
    for begin in (lambda: merge([part], path), lambda: RunWriter(path, FACTS, WALL, FILES)):
        with pytest.raises(OSError, match="No space left on device") as caught:
            begin()
        assert caught.value.filename.startswith(str(path))
    assert list(path.parent.iterdir()) == [part]


def test_a_write_that_fails_names_the_file_and_the_reason(path: Path) -> None:
    facts = replace(FACTS, particles=5000)
    resource = pytest.importorskip("resource", reason="limits of POSIX")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    with RunWriter(path, facts, WALL, FILES) as writer:
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, before[1]))
            with pytest.raises(OSError, match="File too large") as caught:
                write(writer, states(facts), 0, 1)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert caught.value.filename == str(path)
        assert writer.states == 0
        write(writer, states(facts), 0, 2)
    assert committed_states(path, facts) == 2
