import os
import subprocess
import sys
from pathlib import Path

import pytest

from app.locks import claimed
from places import ROOT
from taichi_sph.errors import InputError

HOLD = """
import sys
from pathlib import Path
from app.locks import claimed
with claimed(Path(sys.argv[1]), "--rrd"):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_file_that_is_claimed_is_nobody_elses_and_free_again_afterwards(tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    with (
        claimed(path, "--rrd"),
        claimed(tmp_path / "b.rrd", "--rrd"),
        pytest.raises(InputError, match=r"--summary .*a.rrd: another run is writing it"),
        claimed(path, "--summary"),
    ):
        pass
    with claimed(path, "--rrd"):
        path.write_text("x")
    assert [file.name for file in tmp_path.iterdir()] == ["a.rrd"]


def test_a_file_by_another_name_is_the_same(tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    path.write_text("x")
    (tmp_path / "link").symlink_to(path)
    (tmp_path / "below").mkdir()
    for other in (tmp_path / "link", tmp_path / "below" / ".." / "a.rrd"):
        with claimed(path, "--rrd"), pytest.raises(InputError), claimed(other, "--rrd"):
            pass


def test_nothing_and_devices_are_not_claimed(tmp_path: Path) -> None:
    null = Path(os.devnull)
    with claimed(None, "--rrd"), claimed(null, "--rrd"), claimed(null, "--rrd"):
        pass
    with claimed(tmp_path / "no" / "folder", "--rrd"):  # who writes there says what is wrong
        pass


def test_a_claim_ends_with_a_process_that_is_killed(tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    ) as other:
        assert other.stdout is not None and other.stdout.readline() == "held\n"
        with pytest.raises(InputError, match="another run"), claimed(path, "--rrd"):
            pass
        other.kill()
        other.wait()
    with claimed(path, "--rrd"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_where_nothing_can_be_made_beside_it_a_file_is_claimed_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.rrd"
    path.write_text("x")
    # As in a folder that may not be written; root may everywhere.
    (tmp_path / ".a.rrd.lock").mkdir()
    with claimed(path, "--rrd"), pytest.raises(InputError), claimed(path, "--rrd"):
        pass
    assert path.read_text() == "x"
