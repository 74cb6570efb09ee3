"""Whole files and locks."""

import os
from pathlib import Path

import pytest

from taichi_sph.system import largest_memory, lock, processors, replaced


def test_a_file_is_the_old_one_or_the_whole_new_one(tmp_path: Path) -> None:
    path = tmp_path / "weights.npz"
    for content in (b"first", b"second"):
        with replaced(path) as file:
            file.write(content)
        assert path.read_bytes() == content
    with pytest.raises(OSError, match="disk is full"), replaced(path) as file:
        file.write(b"half")
        raise OSError("the disk is full")
    assert path.read_bytes() == b"second"
    assert [p.name for p in tmp_path.iterdir()] == ["weights.npz"]


def test_a_file_may_be_read_by_whom_the_user_lets(tmp_path: Path) -> None:
    plain = tmp_path / "plain"
    plain.write_text("")
    with replaced(tmp_path / "replaced") as file:
        file.write(b"x")
    assert (tmp_path / "replaced").stat().st_mode == plain.stat().st_mode


def test_a_device_is_written_and_not_replaced() -> None:
    with replaced(Path(os.devnull)) as file:
        file.write(b"x")
    assert not Path(os.devnull).is_file()


def test_a_file_that_grows_under_a_known_name_leaves_one_only(tmp_path: Path) -> None:
    (tmp_path / "data.h5.part").write_bytes(b"of a run that was killed, and longer than the new")
    with replaced(tmp_path / "data.h5", tmp_path / "data.h5.part") as file:
        file.write(b"new")
        assert (tmp_path / "data.h5.part").exists()
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("data.h5", b"new")]


def test_a_lock_is_of_one_holder_until_the_file_is_closed(tmp_path: Path) -> None:
    path = tmp_path / "part"
    path.write_bytes(b"")
    with path.open("r+b") as first:
        assert lock(first)
        with path.open("r+b") as second:
            assert not lock(second)
    with path.open("r+b") as third:
        assert lock(third)


def test_the_machine_says_what_it_has() -> None:
    assert len(processors()) >= 1
    assert 1e6 < largest_memory() < 1e15  # bytes: numpy alone is more than a megabyte
