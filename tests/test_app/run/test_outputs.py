import json
import math
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from app.run.loop import Outcome, drive
from app.run.options import RunOptions
from app.run.outputs import claimed_outputs, quoted, report, summary_text
from app.scenes.library import find_scene
from fake_simulation import FakeSimulation
from taichi_sph.errors import InputError


@pytest.fixture(scope="module")
def outcome() -> Outcome:
    simulation: Any = FakeSimulation()
    return drive(simulation, [], 0.02, 0.01)


def claim(**given: Any) -> None:
    with claimed_outputs(RunOptions("box", **given), find_scene("box")):
        pass


def test_only_a_summary_is_replaced_by_one(tmp_path: Path, outcome: Outcome) -> None:
    path = tmp_path / "a.json"
    claim(summary=path)
    path.write_text("")
    claim(summary=path)
    report(outcome, RunOptions("box", summary=path))
    assert json.loads(path.read_text())["scene"] == "box"
    claim(summary=path)
    for text in ('{"a": 1}', '{"scene": "box"}', "{", "[1, 2]", "{" * 100_000, "text"):
        path.write_text(text)
        with pytest.raises(InputError, match=r"--summary .*a.json: the file exists and is "):
            claim(summary=path)
        assert path.read_text() == text


def test_two_outputs_are_two_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a"
    with pytest.raises(InputError, match=r"--summary .*: is the file of --rrd"):
        claim(rrd=path, summary=path)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"--checkpoint .*: is the file of --rrd"):
        claim(rrd=tmp_path / "box.checkpoint.npz", checkpoint=1)
    null = Path("/dev/null")
    if null.exists():
        claim(rrd=null, summary=null)


@pytest.mark.parametrize("option", ["rrd", "summary", "session"])
def test_two_runs_are_two_files(option: str, tmp_path: Path) -> None:
    given: dict[str, Any] = {option: tmp_path / "a"}
    options, scene = RunOptions("box", **given), find_scene("box")
    with claimed_outputs(options, scene):
        with pytest.raises(InputError, match=rf"^--{option} .*a: another run is writing it"):
            claim(**given)
        claim(**{option: tmp_path / "b"})
    claim(**given)
    assert list(tmp_path.iterdir()) == []


def test_a_path_is_quoted_for_a_command_line() -> None:
    for path in ("a.rrd", "a b.rrd", "it's.rrd", "a[1];$x.rrd"):
        said = subprocess.run(["sh", "-c", f"printf %s {quoted(Path(path))}"], capture_output=True)
        assert said.stdout.decode() == path
    assert quoted(Path("a.rrd")) == "a.rrd"


def test_the_summary_counts_what_falls_and_what_is_driven(outcome: Outcome) -> None:
    falling = replace(outcome.summary, blood_particles=13134, particles=5000)
    assert "5000 of 13134 blood particles left" in summary_text(falling)
    driven = replace(falling, particles=15769, added_volume=1e-6, drained={"top": 3, "side": 0})
    text = summary_text(driven)
    assert "15 769 blood particles (started with 13 134)" in text
    assert "particles drained: top 3, side 0" in text


def test_a_run_that_finished_no_frame_has_no_cost_of_a_step(outcome: Outcome) -> None:
    text = summary_text(replace(outcome.summary, median_step_ms=math.nan))
    assert "nan" not in text
    assert "no frame was finished" in text
