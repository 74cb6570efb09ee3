import os
import subprocess
import sys
from pathlib import Path

import pytest

from app.jobs.process import in_own_process
from places import ROOT

ALL = len(os.sched_getaffinity(0)) if sys.platform == "linux" else 0


def affinities(threads: int | None) -> list[frozenset[int]]:
    """Processors that each thread of a process may use after Taichi has started."""
    from taichi_sph import start

    start("cpu", threads=threads)
    return [frozenset(os.sched_getaffinity(int(t))) for t in os.listdir("/proc/self/task")]


@pytest.mark.skipif(ALL < 2, reason="needs Linux and two processors")
def test_each_processor_has_a_thread_of_its_own_when_all_are_used():
    found = in_own_process(affinities, None)
    own = [next(iter(mask)) for mask in found if len(mask) == 1]
    assert sorted(own) == sorted(os.sched_getaffinity(0))


@pytest.mark.skipif(ALL < 2, reason="needs Linux and two processors")
def test_programs_with_fewer_threads_do_not_share_the_first_processor():
    assert all(len(mask) == ALL for mask in in_own_process(affinities, ALL - 1))


RUN = """
from taichi_sph import start
start("cpu")
import taichi as ti
f = ti.field(float, 4)
@ti.kernel
def fill():
    for i in f:
        f[i] = 2.0 * i
fill()
assert f.to_numpy().tolist() == [0.0, 2.0, 4.0, 6.0]
"""


def homes(folder: Path) -> dict[str, dict[str, str] | None]:
    """Environments by what is wrong with them; None takes a variable away."""
    (folder / "file").write_text("")
    cache = folder / "cache is a file"
    cache.mkdir()
    (cache / ".cache").write_text("")
    return {
        "home is a file": {"HOME": str(folder / "file")},
        "home is below a file": {"HOME": str(folder / "file" / "home")},
        "its cache is a file": {"HOME": str(cache)},
        "the cache is a file": {"XDG_CACHE_HOME": str(folder / "file")},
        "kernels below a file": {"TI_OFFLINE_CACHE_FILE_PATH": str(folder / "file" / "kernels")},
        "no home": None,
    }


@pytest.mark.parametrize("wrong", [
    "home is a file", "home is below a file", "its cache is a file", "the cache is a file",
    "kernels below a file", "no home",
])  # fmt: skip
def test_a_home_that_cannot_be_written_costs_the_cache_alone(wrong: str, tmp_path: Path) -> None:
    # Root writes everywhere: a file in the place of a folder stops it too.
    given = homes(tmp_path)[wrong]
    program = tmp_path / "program.py"  # Taichi reads a kernel's source from its file
    program.write_text(RUN)
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    environment = os.environ | {"PYTHONPATH": str(ROOT), "TMPDIR": str(scratch)} | (given or {})
    for name in ("XDG_CACHE_HOME", "TI_OFFLINE_CACHE_FILE_PATH", *(["HOME"] * (given is None))):
        if name not in (given or {}):
            environment.pop(name, None)
    done = subprocess.run(
        [sys.executable, str(program)], env=environment, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert not list(scratch.iterdir()), "what was put aside has gone with the process"


def test_nothing_that_can_be_written_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    from taichi_sph import InputError, runtime

    def full(**_: object) -> str:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(runtime, "_can_write", lambda folder: False)
    monkeypatch.setattr(runtime.tempfile, "mkdtemp", full)
    with pytest.raises(InputError, match=r"^no folder can be written for compiled kernels; let "):
        runtime._kernel_cache()


def test_kernels_are_kept_again_after_a_process_was_killed_while_it_wrote_them(tmp_path):
    def run() -> None:
        environment = os.environ | {
            "PYTHONPATH": str(ROOT), "TI_OFFLINE_CACHE_FILE_PATH": str(tmp_path)
        }  # fmt: skip
        # From a file: Taichi reads the source of its kernels.
        script = tmp_path / "run.py"
        script.write_text(RUN)
        subprocess.run([sys.executable, script], env=environment, check=True)

    lock = tmp_path / "ticache.lock"
    lock.touch()
    run()
    assert not list(tmp_path.glob("*.tic")), "Taichi leaves a folder alone that another writes"
    os.utime(lock, (0.0, 0.0))
    run()
    assert list(tmp_path.glob("*.tic"))
    assert not lock.exists()
