import json
import os
import signal
import threading
import time
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from app.files import check_output, write_json
from app.progress import Progress, duration
from app.run.loop import drive, frame_time
from fake_simulation import FakeSimulation
from taichi_sph.errors import InputError


class Watcher:
    """An observer that keeps what it was told."""

    def __init__(self, fails_at: int | None = None, acts_at: Any = None):
        self.times: list[float] = []
        self.endings: list[str] = []
        self.fails_at, self.acts_at = fails_at, acts_at

    def on_frame(self, simulation: Any, frame: int, figures: Any) -> None:
        assert frame == len(self.times)
        self.times.append(figures.time)
        if frame == self.fails_at:
            raise OSError("run.rrd: no space")
        if self.acts_at and frame == self.acts_at[0]:
            self.acts_at[1]()

    def close(self, ending: str) -> None:
        self.endings.append(ending)


def run(simulation: Any, *observers: Any, until: float = 0.05, interval: float = 0.01) -> Any:
    return drive(simulation, observers, until, interval)


def test_frames_are_at_products_of_the_interval_and_end_at_until() -> None:
    watcher = Watcher()
    outcome = run(FakeSimulation(), watcher, until=0.035)
    assert watcher.times == [0.0, 0.01, 0.02, 0.03, 0.035]
    assert watcher.endings == ["finished"]
    assert outcome.summary.frames == 4
    assert outcome.summary.steps == 16
    assert outcome.summary.simulated_time == 0.035


@pytest.mark.parametrize("interval", [0.1, 1e-3, 1.0 / 3.0, 0.7])
def test_a_whole_number_of_frames_is_not_one_more_by_rounding(interval: float) -> None:
    for frames in (1, 3, 7, 1000):
        until = sum([interval] * frames)
        assert frame_time(frames, interval, until) == until
        assert frame_time(frames - 1, interval, until) == (frames - 1) * interval


def test_the_median_step_is_measured_without_observers() -> None:
    slow = Watcher()
    slow.on_frame = lambda *_: time.sleep(0.05)  # type: ignore[method-assign]
    outcome = run(FakeSimulation(pause=0.008), slow)
    # 8 ms for the 4 steps of a frame; sleeping overshoots on a busy machine.
    assert 2.0 <= outcome.summary.median_step_ms < 10.0
    assert outcome.summary.wall_time > 0.3
    assert outcome.summary.real_time_factor == pytest.approx(0.05 / outcome.summary.wall_time)


def test_a_diverged_run_is_summed_up_and_closed() -> None:
    watcher = Watcher()
    outcome = run(FakeSimulation(diverges_at=0.025), watcher)
    assert outcome.summary.diverged
    assert outcome.summary.simulated_time == 0.02
    assert outcome.summary.ending == "the run diverged: particle 3 is not finite"
    assert watcher.endings == [outcome.summary.ending]


def test_an_observer_that_cannot_write_ends_the_run_and_the_others_are_closed() -> None:
    first, second = Watcher(), Watcher(fails_at=2)
    outcome = run(FakeSimulation(), first, second)
    assert isinstance(outcome.error, OSError)
    assert not outcome.summary.diverged
    assert first.times == [0.0, 0.01, 0.02]
    assert first.endings == second.endings == ["run.rrd: no space"]


def test_an_unforeseen_error_closes_the_observers_and_is_not_hidden() -> None:
    def stumble() -> None:
        raise ZeroDivisionError("a bug")

    watcher = Watcher(acts_at=(1, stumble))
    with pytest.raises(ZeroDivisionError):
        run(FakeSimulation(), watcher)
    assert watcher.endings == ["failed: a bug"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_advancing_ends_the_run_with_its_last_frame(number: int) -> None:
    handlers = [signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)]
    watcher = Watcher()
    simulation = FakeSimulation(pause=0.2)
    threading.Timer(0.3, os.kill, (os.getpid(), number)).start()
    outcome = run(simulation, watcher, until=10.0)
    assert outcome.signal == number
    assert watcher.times == [0.0, 0.01]
    assert watcher.endings == [f"stopped by {signal.Signals(number).name}"]
    assert outcome.summary.simulated_time == 0.01
    assert [signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)] == handlers


def test_a_signal_while_writing_waits_until_the_frame_is_whole() -> None:
    first = Watcher(acts_at=(1, lambda: os.kill(os.getpid(), signal.SIGTERM)))
    second = Watcher()
    outcome = run(FakeSimulation(), first, second)
    assert outcome.signal == signal.SIGTERM
    assert first.times == second.times == [0.0, 0.01]


def test_an_empty_vessel_ends_the_run() -> None:
    simulation = FakeSimulation()
    full = simulation.diagnostics

    def drained() -> Any:
        figures = full()
        object.__setattr__(figures, "particles", 0 if simulation.time >= 0.03 else 200)
        return figures

    simulation.diagnostics = drained  # type: ignore[method-assign]
    outcome = run(simulation)
    assert outcome.summary.ending == "all blood has left the vessel"
    assert outcome.summary.simulated_time == 0.03


def test_progress_off_a_terminal_is_plain_lines_with_time_left() -> None:
    out = StringIO()
    progress = Progress(1.0, "scene", Console(file=out, force_terminal=False, width=200))
    progress.show(0.0, 0, 0)
    progress.show(0.1, 10, 0)
    progress._shown = -1e9  # as if long ago
    time.sleep(0.05)
    progress.show(0.2, 20, 3)
    lines = out.getvalue().splitlines()
    assert lines[0] == "0.0000 of 1 s, 0 steps"
    assert lines[1].startswith("0.2000 of 1 s, 20 steps, ")
    assert "x real time" in lines[1]
    assert lines[1].endswith(" left, 3 leaks")
    assert len(lines) == 2


def test_progress_on_a_terminal_is_a_bar_that_is_taken_down() -> None:
    out = StringIO()
    progress = Progress(1.0, "scene", Console(file=out, force_terminal=True, width=120))
    progress.show(0.5, 10, 0)
    progress.close()
    assert "0.5000 of 1 s, 10 steps" in out.getvalue()
    assert "\x1b[?25h" in out.getvalue(), "the cursor is shown again"


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s"), (59.4, "59 s"), (185, "3 min 05 s"), (7800, "2 h 10 min")]
)
def test_durations_are_for_people(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_json_is_replaced_whole(tmp_path: Path) -> None:
    file = tmp_path / "summary.json"
    write_json(file, {"a": 1, "b": float("nan")})
    assert json.loads(file.read_text()) == {"a": 1, "b": None}
    write_json(file, {"rows": [{"b": float("inf"), "c": (1.5, float("nan"))}]})
    assert json.loads(file.read_text()) == {"rows": [{"b": None, "c": [1.5, None]}]}
    write_json(file, {"a": 1, "b": float("nan")})
    with pytest.raises(TypeError):
        write_json(file, {"a": object()})
    assert json.loads(file.read_text()) == {"a": 1, "b": None}
    assert os.listdir(tmp_path) == ["summary.json"]


def test_json_on_a_full_disk_is_an_error() -> None:
    with pytest.raises(OSError, match="No space left"):
        write_json(Path("/dev/full"), {"a": 1})
    assert not Path("/dev/full").is_file()


def test_output_may_replace_its_like_and_nothing_else(tmp_path: Path) -> None:
    file = tmp_path / "file"
    check_output(file, "--rrd", b"RRF2")
    assert not file.exists()
    for content in (b"", b"RRF2 and more"):
        file.write_bytes(content)
        check_output(file, "--rrd", b"RRF2")
        assert file.read_bytes() == content
    file.write_bytes(b"my thesis")
    with pytest.raises(InputError, match=f"--rrd {file}: the file exists and is something else"):
        check_output(file, "--rrd", b"RRF2")
    assert file.read_bytes() == b"my thesis"
