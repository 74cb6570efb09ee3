"""Nothing that only POSIX has is needed: the program with those names taken away."""

import gc
import os
import subprocess
import sys
from pathlib import Path

import pytest
import rerun as rr

from app.view import rerun_streams
from places import ROOT
from recordings import free_port, verify

TAKEN_AWAY = """
import builtins, os, select, signal, socket, sys
for name in ("pwrite", "pread", "fork", "forkpty", "sched_getaffinity", "sched_setaffinity",
             "posix_fallocate", "fchmod", "fchown", "chown",
             "getuid", "geteuid", "mkfifo", "sync", "nice", "killpg", "setsid", "getloadavg"):
    if hasattr(os, name):
        delattr(os, name)
for name in ("SIGHUP", "SIGKILL", "SIGUSR1", "SIGUSR2", "SIGALRM", "SIGPIPE", "pause", "alarm"):
    if hasattr(signal, name):
        delattr(signal, name)
for name in ("poll", "epoll"):
    if hasattr(select, name):
        delattr(select, name)
ours = ("app", "nn", "taichi_sph")
plain = builtins.__import__
def without(name, globals=None, locals=None, fromlist=(), level=0):
    # Libraries ask by the name of the system; what is ours may not ask at all.
    asks = (globals or {}).get("__name__", "").split(".")[0]
    if name in ("fcntl", "resource", "pwd", "grp", "termios") and asks in ours:
        raise ImportError(name)
    return plain(name, globals, locals, fromlist, level)
builtins.__import__ = without
"""

IMPORTS = """
import importlib, sys
from pathlib import Path
for package in ("taichi_sph", "nn", "app"):
    for file in sorted(Path(sys.argv[1], package).rglob("*.py")):
        parts = file.relative_to(sys.argv[1]).with_suffix("").parts
        if parts[-1] not in ("__main__", "__init__"):
            importlib.import_module(".".join(parts))
"""

COMMANDS = """
import json, socket, sys, threading, time
from app.cli import invoke

def do(*command):
    message, code = invoke([str(part) for part in command])
    assert (message, code) == ("", 0), (command, message, code)

def gravity(port, replies):
    # A client of the channel: it asks once it is let in.
    while True:
        try:
            client = socket.create_connection(("127.0.0.1", port))
            break
        except OSError:
            time.sleep(0.05)
    with client, client.makefile("rw") as lines:
        asked = {"command": "gravity", "vector": [0, 0, -5], "id": 1}
        print(json.dumps(asked), file=lines, flush=True)
        replies += [json.loads(lines.readline()) for _ in range(2)]

scene, port = sys.argv[1], int(sys.argv[2])
do("run", scene, "--frames", 2, "--rrd", "run.rrd", "--summary", "run.json", "--checkpoint", 1)
do("record", scene, "--heights", "0.008,0.01", "--frames", 6, "--substeps", 4, "--out", "data.h5")
do("train", "data.h5", "--out", "w.npz", "--iterations", 2)
replies = []
threading.Thread(target=gravity, args=(port + 1, replies), daemon=True).start()
do("run", scene, "--control", port, "--until", 0.02, "--session", "s.jsonl", "--model", "implicit")
assert [r["id"] for r in replies] == [1, 1] and "applied" in replies[1], replies
do("replay", "s.jsonl")
"""


@pytest.fixture
def elsewhere(tmp_path: Path) -> dict[str, str]:
    """Environment of a Python from which the names are gone."""
    (tmp_path / "sitecustomize.py").write_text(TAKEN_AWAY)
    # Windows names the user, whom the standard library asks the system for elsewhere.
    here = {"PYTHONPATH": os.pathsep.join((str(tmp_path), str(ROOT))), "USERNAME": "somebody"}
    return os.environ | here


def test_every_module_is_imported(elsewhere: dict[str, str], tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="torch is an extra: pip install 'vesselflow[train]'")
    pytest.importorskip("viser", reason="viser is an extra: pip install 'vesselflow[control]'")
    done = subprocess.run(
        [sys.executable, "-c", IMPORTS, str(ROOT)],
        env=elsewhere, cwd=tmp_path, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


@pytest.mark.validation
def test_a_vessel_is_run_recorded_trained_on_and_controlled(
    elsewhere: dict[str, str], box: Path, tmp_path: Path
) -> None:
    pytest.importorskip("torch", reason="torch is an extra: pip install 'vesselflow[train]'")
    pytest.importorskip("viser", reason="viser is an extra: pip install 'vesselflow[control]'")
    done = subprocess.run(
        [sys.executable, "-c", COMMANDS, str(box), str(free_port())],
        env=elsewhere, cwd=tmp_path, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert verify(tmp_path / "run.rrd")
    left = {"run.rrd", "run.json", "data.h5", "w.npz", "s.jsonl"}
    assert left <= {file.name for file in tmp_path.iterdir()}


def test_a_recording_is_whole_where_a_pipe_has_no_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rerun_streams, "named_pipe", lambda: None)
    path = tmp_path / "x.rrd"
    stream = rerun_streams.open_stream("vesselflow test", "one", 0.01)
    writer = rerun_streams.FileWriter(path)
    stream.set_sinks(rr.FileSink(writer.sink_path))
    writer.opened()
    rerun_streams.send(stream, 0, 0.0, [("world/blood", rr.Points3D([[1.0, 2.0, 3.0]]))])
    stream.flush()
    writer.drain()
    writer.check()
    del stream
    gc.collect()
    writer.close()
    assert verify(path, footers=False)
