import math
from pathlib import Path
from typing import Any

import pytest

from app.run.options import RunOptions
from app.scenes.library import find_scene
from taichi_sph.errors import InputError

FILE = Path("a.npz")
CONTRADICTIONS: dict[str, dict[str, Any]] = {
    "--frames and --until": {"frames": 2, "until": 0.1},
    "--particles and --height": {"particles": 5, "height": 0.1},
    "--every: nothing is shown": {"every": 2},
    "--weights: only --model pcnet": {"weights": FILE},
    "--checkpoint and --resume: name the model": {"model": "auto", "checkpoint": 2},
    "--checkpoint and --resume: name": {"model": "auto", "resume": FILE},
    "--model auto: pours a scene first": {"model": "auto", "script": FILE},
    "--error: only --model auto": {"error": 0.2},
    "--live 8081: is a port of --control": {"live": 8081, "control": 8080},
}


@pytest.mark.parametrize("sentence", CONTRADICTIONS)
def test_options_that_contradict_each_other_are_refused(sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        RunOptions("box", **CONTRADICTIONS[sentence])


@pytest.mark.parametrize("given", [
    {"every": 2, "rrd": Path("a.rrd")},
    {"every": 2, "live": 9876},
    {"weights": FILE, "model": "pcnet"},
    {"weights": FILE, "control": 8080},
    {"model": "auto", "error": 0.2},
    {"live": 9876, "control": 8080},
])  # fmt: skip
def test_options_that_go_together_are_taken(given: dict[str, Any]) -> None:
    RunOptions("box", **given)


def test_a_run_ends_where_it_is_told_to() -> None:
    scene = find_scene("box")
    assert RunOptions("box").end(scene) == scene.duration
    assert RunOptions("box", until=0.2).end(scene) == 0.2
    assert RunOptions("box", frames=3).end(scene) == 3 * scene.frame_interval
    assert RunOptions("box", control=8080).end(scene) == math.inf
    assert RunOptions("box", control=8080, frames=3).end(scene) == 3 * scene.frame_interval


def test_a_log_is_never_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    scene = find_scene("box")
    asked = RunOptions("box", control=1)
    assert RunOptions("box").session_file(scene) is None
    assert RunOptions("box", session=FILE).session_file(scene) == FILE
    for name in ("box.session.jsonl", "box.2.session.jsonl", "box.3.session.jsonl"):
        assert asked.session_file(scene) == Path(name)
        Path(name).write_text("")  # of a start that was refused
        assert asked.session_file(scene) == Path(name)
        Path(name).write_text("{}")
