import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.cli import invoke
from app.cli.run import replay
from app.cli.run import run as run_command
from app.scenes.library import shipped
from app.view.appearance import COLOURINGS
from fake_simulation import FakeSimulation
from places import ROOT
from recordings import environment, positions, verify
from taichi_sph.errors import InputError
from taichi_sph.geometry.surface_file import load_surface

PATIENCE = 180.0
"""Longest that a busy machine may take for a run of a few seconds [s]."""
INSTANT = 2.0
"""--help takes 0.1 s of processor time; it may not begin to import Taichi (0.4 s) or SciPy."""

SCENE = """
title = "A small tank"
duration = 0.5
frame_interval = 0.002
gravity = [0.0, 0.0, -9.81]

[vessel]
surface = "{surface}"

[openings.top]
centre = [0.0, 0.0, 0.02]
state = "capped"

[column]
opening = "top"
height = 0.02
offset = 0.02

[blood]
density = 1060.0
rheology = {{ model = "newtonian" }}

[discretization]
spacing = 0.002
"""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A scene with few particles in the shipped box."""
    file = tmp_path / "scene.toml"
    file.write_text(SCENE.format(surface=shipped()["box"].parent / "lumen.ply"))
    return file


def vesselflow(
    *arguments: object, variables: dict[str, str] | None = None, **how: Any
) -> subprocess.CompletedProcess[str]:
    """Run the command as a user would."""
    return subprocess.run(
        [sys.executable, "-m", "app", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        env=environment() | (variables or {}),
        **how,
    )


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the command in this process, whose Taichi has been started already."""
    monkeypatch.setattr("taichi_sph.runtime.start", lambda *_, **__: None)


# Runs


def test_a_run_from_another_folder_leaves_a_recording_and_a_summary(
    scene: Path, tmp_path: Path
) -> None:
    rrd, summary = tmp_path / "run.rrd", tmp_path / "summary.json"
    wall = tmp_path / "wall.vtp"
    done = vesselflow(
        "run", scene, "--frames", 3, "--rrd", rrd, "--summary", summary, "--wall-stress", wall,
        cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "Taichi" not in done.stdout + done.stderr
    told = json.loads(summary.read_text())
    assert told["scene"] == tmp_path.name
    assert told["model"] == "physics"
    assert told["frames"] == 3
    assert told["simulated_time"] == pytest.approx(0.006)
    assert told["blood_particles"] > 500
    assert told["proxy_particles"] > 500
    assert told["leaks"] == 0
    assert not told["diverged"]
    assert 0.0 < told["kinetic_energy"] < 1e-4
    assert told["steps"] > 3
    assert told["median_step_ms"] > 0.0
    for key in ("wall_time", "real_time_factor", "wall_corrections", "compression_p99"):
        assert told[key] >= 0.0
    assert told["drained_volume"] == 0.0
    assert verify(rrd)
    found = positions(rrd)
    assert sorted(found) == [0, 1, 2, 3]
    assert {len(x) for x in found.values()} == {told["blood_particles"]}
    assert f"recording: {rrd}" in done.stdout
    vertices, faces = load_surface(wall)
    lumen, _ = load_surface(shipped()["box"].parent / "lumen.ply")
    assert len(faces) > 0
    assert np.ptp(vertices, axis=0) == pytest.approx(np.ptp(lumen, axis=0), rel=1e-6)


class Keeper:
    """An observer that keeps the positions."""

    def __init__(self) -> None:
        self.positions: list[np.ndarray] = []

    def on_frame(self, simulation: Any, frame: int, figures: Any) -> None:
        self.positions.append(simulation.positions())

    def close(self, ending: str) -> None:
        assert ending == "finished"


@pytest.mark.validation
def test_positions_recorded_are_those_of_the_simulation(scene: Path, tmp_path: Path) -> None:
    from app.run.loop import drive
    from app.view.rerun_view import RerunView
    from taichi_sph.scene import read_scene
    from taichi_sph.simulation import Simulation

    simulation = Simulation.from_scene(read_scene(scene))
    keeper = Keeper()
    outcome = drive(simulation, [RerunView(simulation, tmp_path / "a.rrd"), keeper], 0.006, 0.002)
    assert outcome.error is None
    found = positions(tmp_path / "a.rrd")
    assert sorted(found) == [0, 1, 2, 3]
    for frame, x in found.items():
        np.testing.assert_array_equal(x, keeper.positions[frame].astype(np.float32))
    assert np.abs(found[3] - found[0]).max() > 0.0
    # Begun again from the same blood, it does the same: to rounding, for sums go by another order.
    end = simulation.positions()
    start = keeper.positions[0]
    simulation.restart_with(start, np.zeros_like(start))
    assert (simulation.time, simulation.steps) == (0.0, 0)
    for frame in (1, 2, 3):
        simulation.advance_to(0.002 * frame)
    assert np.abs(simulation.positions() - end).max() < 1e-9
    with pytest.raises(InputError, match="there is room for"):
        simulation.restart_with(np.concatenate([start, start]), np.zeros((2 * len(start), 3)))


@pytest.mark.parametrize(
    ("number", "code"),
    [pytest.param(signal.SIGINT, 130, marks=pytest.mark.validation), (signal.SIGTERM, 143)],
)
def test_a_signal_ends_a_run_with_its_files_whole(
    scene: Path, tmp_path: Path, number: int, code: int
) -> None:
    rrd, summary = tmp_path / "run.rrd", tmp_path / "summary.json"
    command = [sys.executable, "-m", "app", "run", scene, "--until", 100.0]
    command += ["--rrd", rrd, "--summary", summary]
    with subprocess.Popen(
        [str(part) for part in command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(),
    ) as program:
        deadline = time.monotonic() + PATIENCE
        while not (rrd.exists() and rrd.stat().st_size > 200_000):
            assert program.poll() is None and time.monotonic() < deadline
            time.sleep(0.02)
        program.send_signal(number)
        _, complaint = program.communicate(timeout=PATIENCE)
    assert program.returncode == code
    assert "Traceback" not in complaint
    assert verify(rrd)
    told = json.loads(summary.read_text())
    assert told["ending"] == f"stopped by {signal.Signals(number).name}"
    assert told["frames"] == len(positions(rrd)) - 1 > 0


def test_a_full_disk_is_exit_code_2_and_a_sentence(scene: Path, tmp_path: Path) -> None:
    summary = tmp_path / "summary.json"
    done = vesselflow("run", scene, "--frames", 3, "--rrd", "/dev/full", "--summary", summary)
    assert done.returncode == 2
    complaint = done.stderr.splitlines()[-1]
    assert complaint.startswith("/dev/full: the recording cannot be written: No space left")
    assert "Traceback" not in done.stderr
    assert json.loads(summary.read_text())["ending"] == complaint


@pytest.mark.usefixtures("in_process")
def test_a_run_that_diverges_is_exit_code_1_with_its_summary(
    scene: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    failing = FakeSimulation(diverges_at=0.003)
    monkeypatch.setattr("taichi_sph.simulation.Simulation.from_scene", lambda *_, **__: failing)
    summary = tmp_path / "summary.json"
    message, code = invoke(["run", str(scene), "--frames", "2", "--summary", str(summary)])
    assert code == 1
    assert message == "the run diverged: particle 3 is not finite"
    told = json.loads(summary.read_text())
    assert told["diverged"]
    assert told["ending"] == message
    assert "the run diverged" in capsys.readouterr().out


# What is wrong is said in one sentence


def replaced(old: str, new: str) -> Any:
    def change(scene: Path) -> list[str]:
        text = scene.read_text()
        assert old in text
        scene.write_text(text.replace(old, new))
        return [str(scene)]

    return change


def options(*given: str) -> Any:
    return lambda scene: [str(scene), *given]


BAD = {
    "unknown scene": (lambda _: ["aortailiac"], "did you mean aortoiliac?"),
    "nothing like a scene": (lambda _: ["xyz"], "neither a shipped scene nor a scene file"),
    "folder without scene": (lambda scene: [str(scene.parent.parent)], "has no scene.toml"),
    "surface for scene": (
        lambda _: [str(shipped()["box"].parent / "lumen.ply")],
        "a scene is a .toml file",
    ),
    "not TOML": (replaced("title = ", "title ? "), "not a TOML file"),
    "unknown key": (replaced("duration", "durration"), "durration"),
    "unknown table": (replaced("[blood]", "[bloed]"), "bloed"),
    "missing key": (replaced("duration = 0.5", ""), "duration"),
    "negative density": (replaced("1060.0", "-1060.0"), "> 0"),
    "text for number": (replaced("1060.0", '"heavy"'), "density"),
    "unknown rheology": (replaced("newtonian", "honey"), "honey"),
    "height and particles": (replaced("height = 0.02", "height = 0.02\nparticles = 9"), "one of"),
    "no such opening": (replaced('opening = "top"', 'opening = "tap"'), "allowed: top"),
    "not finite": (replaced("frame_interval = 0.002", "frame_interval = inf"), "inf"),
    "gravity of two": (replaced("[0.0, 0.0, -9.81]", "[0.0, -9.81]"), "gravity"),
    "no surface file": (replaced("lumen.ply", "lumina.ply"), "lumina.ply"),
    "opening elsewhere": (replaced("centre = [0.0, 0.0, 0.02]", "centre = [9.0, 0.0, 0.0]"), "top"),
    "millimetres": (replaced('lumen.ply"', 'lumen.ply"\nscale = 1000.0'), "scale"),
    "coarse": (replaced("spacing = 0.002", "spacing = 0.5"), "spacing"),
    "column too high": (options("--height", "3.0"), "3"),
    "too many particles": (options("--particles", "1000000"), "particles"),
    "height and particles asked for": (
        options("--height", "0.1", "--particles", "5"),
        "one of the two",
    ),
    "frames and until": (options("--frames", "2", "--until", "1"), "one of the two"),
    "no frames": (options("--frames", "0"), "--frames"),
    "every of nothing": (options("--every", "2"), "--every"),
    "budget of nothing": (options("--error", "0.2"), "--error"),
    "unknown option": (options("--gpu"), "--gpu"),
    "port out of range": (options("--live", "70000"), "--live"),
    "recording into no folder": (options("--rrd", "/no/such/run.rrd"), "does not exist"),
    "recording onto a folder": (options("--rrd", "/tmp"), "is a folder"),
    "summary into no folder": (options("--summary", "/no/such/summary.json"), "does not exist"),
    "recording onto the scene": (
        lambda scene: [str(scene), "--rrd", str(scene)],
        "something else",
    ),
    "recording below a file": (
        lambda scene: [str(scene), "--rrd", str(scene / "run.rrd")],
        "does not exist",
    ),
}


@pytest.mark.usefixtures("in_process")
@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_sentence_and_exit_code_2(case: str, scene: Path) -> None:
    arguments, part = BAD[case]
    before = scene.read_text()
    given = arguments(scene)
    message, code = invoke(["run", *given, *([] if "--frames" in given else ["--until", "0.004"])])
    assert code == 2, message
    assert part in message
    assert "\n" not in message
    if case == "recording onto the scene":
        assert scene.read_text() == before


def test_bad_input_leaves_no_traceback_and_nothing_on_stdout() -> None:
    done = vesselflow("run", "nowhere")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1


def test_a_gpu_that_is_absent_is_exit_code_2(scene: Path) -> None:
    if Path("/dev/nvidia0").exists() or sys.platform == "darwin":
        pytest.skip("this machine has a GPU")
    # A Vulkan driver that computes on the CPU is no GPU; without any, Taichi would crash.
    done = vesselflow("run", scene, "--arch", "gpu", "--frames", 1)
    assert done.returncode == 2
    assert done.stderr.strip().startswith("--arch gpu: no ")
    assert done.stderr.count("\n") == 1


def test_an_output_is_checked_before_the_slow_part(tmp_path: Path) -> None:
    began = time.process_time()
    _, code = invoke(["run", "A", "--rrd", str(tmp_path)])
    assert code == 2
    assert time.process_time() - began < INSTANT


# The other commands


def test_help_and_the_list_of_scenes_need_neither_taichi_nor_rerun() -> None:
    for arguments in (["--help"], ["scenes"], ["run", "--help"]):
        done = subprocess.run(
            [sys.executable, "-X", "importtime", "-m", "app", *arguments],
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            env=environment(),
        )
        assert done.returncode == 0, done.stderr
        imported = {line.rsplit("|", 1)[-1].strip() for line in done.stderr.splitlines()}
        assert "click" in imported
        assert not imported & {"taichi", "rerun", "scipy", "trimesh", "igl", "torch"}


def test_every_shipped_scene_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke(["scenes"]) == ("", 0)
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines()[1:]]
    assert listed == list(shipped())
    assert {"A", "B", "aortoiliac", "basilar_bifurcation", "carotid_siphon", "portal_vein"} <= set(
        listed
    )


def test_info_tells_the_derived_numbers_of_the_run(
    scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from app.scenes.library import find_scene, measure

    assert invoke(["info", str(scene.parent)]) == ("", 0)
    out = capsys.readouterr().out
    *_, derived = measure(find_scene(str(scene)))
    assert f"blood particles           {derived.blood_particles}\n" in "\n".join(
        line.rstrip() for line in out.splitlines()
    )
    for text in ("proxy particles", "sound speed", "Reynolds number", "no self-intersections"):
        assert text in out


def test_new_makes_a_scene_that_can_be_asked_about(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    surface = shipped()["tube"].parent / "lumen.ply"
    folder = tmp_path / "mine"
    assert invoke(["new", str(surface), "--out", str(folder)]) == ("", 0)
    assert capsys.readouterr().out.strip()
    assert invoke(["info", str(folder)]) == ("", 0)
    message, code = invoke(["new", str(surface), "--out", str(folder)])
    assert code == 2
    assert "already exists" in message


def test_a_reader_that_has_had_enough_is_no_traceback() -> None:
    source, sink = os.pipe()
    os.close(source)
    done = subprocess.run(
        [sys.executable, "-m", "app", "scenes"],
        stdout=sink,
        stderr=subprocess.PIPE,
        text=True,
        timeout=PATIENCE,
        env=environment(),
    )
    os.close(sink)
    assert done.returncode == 1
    assert done.stderr == ""


def test_the_version_is_that_of_the_project() -> None:
    done = vesselflow("--version")
    assert done.returncode == 0, done.stderr
    if "not installed" in done.stdout:
        pytest.skip("vesselflow is not installed here; make test installs it")
    text = (ROOT / "pyproject.toml").read_text()
    assert f'version = "{done.stdout.split()[-1]}"' in text


def test_what_colours_may_mean_is_what_pictures_know() -> None:
    # A list of its own, for options are read without numpy.
    for command in (run_command, replay):
        (colour,) = (option for option in command.params if option.name == "colour")
        assert tuple(colour.type.choices) == COLOURINGS  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    "command",
    [
        ("bench", "box", "--json"),
        ("compare", "box", "--json"),
        ("run", "box", "--frames", "1", "--summary"),
    ],
)
def test_json_of_another_program_is_not_replaced(command: tuple[str, ...], tmp_path: Path) -> None:
    file = tmp_path / "package.json"
    file.write_text('{"name": "mine", "scene": 1, "rows": []}')
    message, code = invoke([*command, str(file)])
    assert code == 2 and str(file) in message
    assert file.read_text().startswith('{"name": "mine"')
