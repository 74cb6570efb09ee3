import errno
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any, cast

import msgspec
import numpy as np
import pytest

from app.run.loop import drive
from app.view import rerun_streams
from app.view.appearance import (
    ASPECT,
    COLOURINGS,
    DYE_COLOUR,
    FIELD_OF_VIEW,
    SPEED_COLOURS,
    colour_table,
    colouring,
    eye,
    levels,
    upward,
)
from app.view.rerun_view import PLOTS, RerunView, application_of
from fake_simulation import FakeSimulation
from places import ROOT
from recordings import (
    Viewer,
    environment,
    figures,
    free_port,
    positions,
    rows,
    static,
    verify,
)
from taichi_sph.boundary.wounds import Wound
from taichi_sph.errors import InputError

FAKE = ROOT / "tests" / "helpers" / "fake_simulation.py"
PATIENCE = 120.0
"""Longest that a busy machine may take for a program of a second or two [s]."""
SLOWEST_FRAME = 1.0
"""A frame handed to the view takes 30 ms; a machine that stumbles may take this [s]."""


@pytest.fixture
def simulation() -> Any:
    return FakeSimulation()


def start_fake(
    file: Path, frames: int, particles: int, *port: int, **how: Any
) -> subprocess.Popen[str]:
    command = [sys.executable, FAKE, file, frames, particles, *port]
    return subprocess.Popen(
        [str(part) for part in command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(),
        **how,
    )


def unpacked(colours: Any) -> np.ndarray:
    """Red, green, blue of 0xRRGGBBAA, (n, 3)."""
    return np.array([[c >> shift & 0xFF for shift in (24, 16, 8)] for c in colours])


def of_speed(simulation: Any) -> np.ndarray:
    """Colours of the speeds of a fake simulation, whose blood expects 1 m/s, (n, 3)."""
    speeds = np.linalg.norm(simulation.velocity, axis=1)
    return colour_table(SPEED_COLOURS)[levels(speeds, 1.0)]


def wait_for_frame(program: subprocess.Popen[str], frame: int) -> None:
    for line in cast(IO[str], program.stdout):
        if line.strip() == str(frame):
            return
    raise AssertionError(f"ended before frame {frame}: {program.communicate()[1]}")


def test_the_recording_holds_what_the_simulation_showed(simulation: Any, tmp_path: Path) -> None:
    file = tmp_path / "run.rrd"
    outcome = drive(simulation, [RerunView(simulation, file)], until=0.05, frame_interval=0.01)
    assert outcome.error is None
    assert verify(file)
    found = positions(file)
    assert sorted(found) == list(range(6))
    for frame, x in found.items():
        expected = simulation.start + 0.01 * frame * simulation.velocity
        np.testing.assert_array_equal(x, expected.astype(np.float32))
    colours = rows(file, "/world/blood", "Points3D:colors")[3]
    np.testing.assert_array_equal(unpacked(colours), of_speed(simulation))
    assert figures(file, "leaks", "wall_corrections") == {
        frame: [float(frame > 0), 4.0 * frame] for frame in range(6)
    }
    # All that is plotted is there, in its units: mJ, %, ms.
    assert None not in figures(file, *(figure for _, lines in PLOTS for figure, *_ in lines))[5]
    assert figures(file, "kinetic_energy", "compression_max", "step")[5] == pytest.approx(
        [500.0, 2.0, 0.1]
    )
    radius = 0.5 * simulation.scene.discretization.spacing
    assert static(file, "/world/blood", "Points3D:radii") == pytest.approx(radius)


def test_wounds_and_the_tip_are_shown_until_they_are_gone(simulation: Any, tmp_path: Path) -> None:
    file = tmp_path / "run.rrd"
    at, normal = np.array([0.0, 1e-3, 2e-3]), np.array([0.0, 0.0, 1.0])
    droplets = np.ones((3, 3), np.float32)
    simulation.outlets = SimpleNamespace(droplets=lambda: droplets)
    view = RerunView(simulation, file)
    for frame in range(3):
        simulation.wounds = [Wound(at, at, normal, 1e-3)] if frame == 1 else []
        simulation.suction = SimpleNamespace(rate=1e-6 * (frame == 1), radius=2e-3)
        view.on_frame(simulation, frame, simulation.diagnostics())
    view.close("finished")
    rims = rows(file, "/world/wounds", "LineStrips3D:strips")
    tips = rows(file, "/world/tool", "Points3D:positions")
    assert sorted(rims) == sorted(tips) == [1, 2]
    np.testing.assert_allclose(rims[1].reshape(-1, 3), Wound(at, at, normal, 1e-3).rim(), atol=1e-9)
    assert tips[1].tolist() == [0.0, 0.0, 0.0]
    assert (len(rims[2]), len(tips[2])) == (0, 0)
    assert rows(file, "/world/tool", "Points3D:radii")[1] == pytest.approx(2e-3)
    for entity, look in (("drops", "Points3D"), ("wounds", "LineStrips3D")):
        assert len(static(file, f"/world/{entity}", f"{look}:colors")) == 1


def test_the_recording_holds_the_vessel_and_the_scene(simulation: Any, tmp_path: Path) -> None:
    file = tmp_path / "run.rrd"
    drive(simulation, [RerunView(simulation, file)], until=0.01, frame_interval=0.01)
    vertices = static(file, "/world/vessel", "Mesh3D:vertex_positions").reshape(-1, 3)
    for bound, expected in zip(
        (vertices.min(axis=0), vertices.max(axis=0)), simulation.vessel.bounds, strict=True
    ):
        np.testing.assert_allclose(bound, expected, atol=1e-7)
    text = "".join(static(file, "/scene", "TextDocument:text"))
    assert simulation.scene.text in text
    assert simulation.scene.title in text


def test_every_nth_frame_has_particles_and_every_frame_has_figures(
    simulation: Any, tmp_path: Path
) -> None:
    file = tmp_path / "run.rrd"
    drive(simulation, [RerunView(simulation, file, every=3)], until=0.07, frame_interval=0.01)
    assert sorted(positions(file)) == [0, 3, 6]
    assert sorted(figures(file)) == list(range(8))


def test_a_diverged_run_leaves_a_whole_recording_that_says_so(tmp_path: Path) -> None:
    file = tmp_path / "run.rrd"
    simulation: Any = FakeSimulation(diverges_at=0.025)
    drive(simulation, [RerunView(simulation, file)], until=0.05, frame_interval=0.01)
    assert verify(file)
    assert sorted(positions(file)) == [0, 1, 2]
    (said,) = rows(file, "/log", "TextLog:text").values()
    assert "diverged" in said[0]


def test_sigterm_leaves_a_whole_recording(tmp_path: Path) -> None:
    file = tmp_path / "run.rrd"
    with start_fake(file, 10_000, 500) as program:
        wait_for_frame(program, 20)
        program.terminate()
        said, _ = program.communicate(timeout=PATIENCE)
    assert "stopped by SIGTERM" in said
    assert verify(file)
    assert len(positions(file)) >= 21


@pytest.mark.validation
def test_kill_leaves_a_recording_to_about_the_last_five_seconds(tmp_path: Path) -> None:
    file = tmp_path / "run.rrd"
    with start_fake(file, 10_000, 500) as program:
        wait_for_frame(program, 20)
        time.sleep(6.0)
        program.kill()
    assert verify(file, footers=False)
    with pytest.warns(match="footer|manifest"):
        found = positions(file)
    with pytest.warns(match="footer|manifest"):
        plotted = figures(file)
    assert len(found) >= 21
    assert sorted(found) == list(range(len(found)))
    assert abs(len(plotted) - len(found)) <= 1


def test_at_a_checkpoint_the_file_has_all_so_far(tmp_path: Path) -> None:
    file, copy = tmp_path / "run.rrd", tmp_path / "copy.rrd"
    simulation: Any = FakeSimulation(20_000)
    view = RerunView(simulation, file, checkpoint=4)
    writer: Any = view._writer
    disk = writer._file

    def slowly(data: memoryview) -> int:
        time.sleep(0.02)  # the pipe holds a part of a frame only
        return disk.write(data)

    writer._file = SimpleNamespace(write=slowly, fileno=disk.fileno, close=disk.close)
    for frame in range(6):
        simulation.advance_to(0.01 * frame)
        view.on_frame(simulation, frame, simulation.diagnostics())
        if frame == 4:
            copy.write_bytes(file.read_bytes())
    view.close("tested")
    assert sorted(positions(file)) == [0, 1, 2, 3, 4, 5]
    with pytest.warns(match="footer|manifest"):
        assert sorted(positions(copy)) == [0, 1, 2, 3, 4]


def test_a_full_disk_ends_the_run_with_a_sentence(tmp_path: Path) -> None:
    file, most = tmp_path / "run.rrd", 1_000_000
    simulation: Any = FakeSimulation(5000)
    view = RerunView(simulation, file)
    writer: Any = view._writer
    disk = writer._file

    def write(data: memoryview) -> int:
        room = most - disk.tell()
        if room <= 0:
            raise OSError(errno.EFBIG, "File too large")
        return disk.write(data[:room])

    writer._file = SimpleNamespace(write=write, fileno=disk.fileno, close=disk.close)
    # Bytes go out every few seconds; here the disk is waited for at each frame.
    view._checkpoint = 1
    outcome = drive(simulation, [view], until=100.0, frame_interval=0.01)
    complaint = str(outcome.error)
    assert outcome.exit_code == 2
    assert complaint.startswith(f"{file}: the recording cannot be written: File too large; ")
    assert "\n" not in complaint
    assert file.stat().st_size == most


def test_a_disk_that_fills_up_with_the_last_bytes_is_noticed(
    simulation: Any, tmp_path: Path
) -> None:
    # 50 frames later there would be no frame left to notice it.
    view = RerunView(simulation, Path("/dev/full"))
    with pytest.raises(OSError, match="/dev/full: the recording cannot be written: No space left"):
        view.close("finished")


def test_nobody_looking_at_the_live_view_costs_nothing(
    simulation: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "run.rrd"
    view = RerunView(simulation, file, free_port())
    outcome = drive(simulation, [view], until=1.0, frame_interval=0.01)
    assert outcome.error is None and not outcome.stalled
    assert capfd.readouterr() == ("", "")
    assert verify(file)
    assert sorted(positions(file)) == list(range(101))


def test_a_viewer_gets_the_frames_and_may_vanish(tmp_path: Path) -> None:
    file, port = tmp_path / "run.rrd", free_port()
    with start_fake(file, 200, 5000, port) as program:
        with Viewer(port) as viewer:
            # More than two frames: it is not only the scene that arrives.
            assert len(viewer.read(200_000)) >= 200_000
        with Viewer(port) as viewer:
            assert len(viewer.read(200_000)) >= 200_000
        _, complaint = program.communicate(timeout=PATIENCE)
    assert program.returncode == 0, complaint
    assert verify(file)
    assert sorted(positions(file)) == list(range(201))


def test_a_viewer_that_stalls_loses_frames_and_is_told_of_at_the_end(
    simulation: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rerun_streams, "_LIVE_TIMEOUT", 0.05)
    file = tmp_path / "run.rrd"
    view = RerunView(simulation, file, free_port())
    assert view.live
    stalled, stream = threading.Event(), view.live.stream

    class Frozen:
        """A stream that blocks, as Rerun does for a viewer that does not read."""

        def set_time(self, *_: Any, **__: Any) -> None:
            stalled.wait()

        def __getattr__(self, name: str) -> Any:
            return getattr(stream, name)

    view.live.stream = Frozen()  # type: ignore[assignment]
    outcome = drive(simulation, [view], until=0.2, frame_interval=0.01)
    assert outcome.stalled == (view,) and outcome.error is None
    assert view.live.dropped >= 21 - 1 - rerun_streams._LIVE_QUEUE
    assert verify(file)
    assert sorted(positions(file)) == list(range(21))
    stalled.set()


@pytest.mark.validation
def test_a_frozen_viewer_neither_slows_the_run_nor_costs_the_file_a_frame(tmp_path: Path) -> None:
    file, port = tmp_path / "run.rrd", free_port()
    if shutil.disk_usage(tmp_path).free < 3_000_000_000:
        pytest.skip("Rerun holds half a gigabyte for a viewer before it blocks, so the file grows")
    frames, particles = 150, 400_000
    with start_fake(file, frames, particles, port) as program, Viewer(port) as viewer:
        viewer.read(50_000)
        said, complaint = program.communicate(timeout=PATIENCE)
    assert program.returncode == 0, complaint
    match = re.search(r"finished; dropped (\d+); slowest ([\d.]+)", said)
    assert match
    assert int(match[1]) > 0, "it was not blocked: give it more"
    assert float(match[2]) < SLOWEST_FRAME
    assert verify(file)
    assert sorted(positions(file)) == list(range(frames + 1))
    file.unlink()


def test_a_port_that_is_taken_is_an_input_error(simulation: Any) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(InputError, match=f"--live {port}: .*in use"):
            RerunView(simulation, port=port)


def test_a_rerun_that_is_switched_off_is_an_input_error(
    simulation: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RERUN", "off")
    with pytest.raises(InputError, match="RERUN"):
        RerunView(simulation, tmp_path / "run.rrd")


# Appearance


def lightness(colour: tuple[int, int, int]) -> float:
    """CIE L* of an sRGB colour."""
    share = np.array(colour) / 255.0
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return 116.0 * np.cbrt(linear @ [0.2126, 0.7152, 0.0722]) - 16.0


def test_the_colours_of_speed_grow_evenly_lighter() -> None:
    steps = np.diff([lightness(colour) for colour in SPEED_COLOURS])
    # A fifth is well under what the eye sees as a band.
    np.testing.assert_allclose(steps, steps.mean(), rtol=0.2)


def test_colours_run_from_rest_to_full_scale() -> None:
    values = np.array([0.0, 1.0, 2.0, 5.0, np.nan, np.inf])
    assert levels(values, full_scale=2.0).tolist() == [0, 127, 255, 255, 255, 255]
    table = colour_table(SPEED_COLOURS)
    assert table.shape == (256, 3)
    assert table[[0, -1]].tolist() == [[0x6B, 0x0F, 0x1A], [0xFF, 0xF2, 0xC2]]


@pytest.mark.parametrize("of", COLOURINGS)
def test_blood_has_the_colour_of_its_speed_or_of_its_age(
    simulation: Any, tmp_path: Path, of: str
) -> None:
    file, duration = tmp_path / "run.rrd", simulation.scene.duration
    simulation.age[:] = np.linspace(0.0, 1.5 * duration, len(simulation.age))
    view = RerunView(simulation, file, colour=of)
    drive(simulation, [view], until=0.01, frame_interval=0.01)
    expected = of_speed(simulation)
    if of == "age":
        anchors = colouring(of, simulation).anchors
        expected = colour_table(anchors)[levels(simulation.age, duration)]
        assert expected[-1].tolist() == [0xFD, 0xE7, 0x25], "the oldest is yellow"
    colours = rows(file, "/world/blood", "Points3D:colors")[1]
    np.testing.assert_array_equal(unpacked(colours), expected)
    assert f"Colour is {of}:" in view._document(simulation)


def test_the_colours_of_age_end_at_twice_the_time_in_which_a_pump_fills_the_vessel(
    simulation: Any,
) -> None:
    def opening(flow: float | None, mean: float) -> Any:
        return SimpleNamespace(flow=flow, waveform=SimpleNamespace(mean=mean))

    volume, duration = simulation.vessel.volume, simulation.scene.duration
    assert colouring("age", simulation).full_scale == duration
    flow = 4.0 * volume / duration
    # What is pumped out and what a reservoir drives do not count.
    simulation.inflow.openings = [opening(flow, 2.0), opening(-flow, 1.0), opening(None, 1.0)]
    assert colouring("age", simulation).full_scale == pytest.approx(duration / 4.0)
    simulation.inflow.openings = [opening(0.1 * flow, 1.0)]
    assert colouring("age", simulation).full_scale == duration


@pytest.mark.parametrize("gravity", [(0, 0, -9.81), (0, -9.81, 0), (3.0, 4.0, 1.0), (0, 0, 0)])
def test_the_eye_has_all_of_the_vessel_in_view(gravity: tuple[float, float, float]) -> None:
    random = np.random.default_rng(3)
    vertices = random.normal(size=(500, 3)) * [0.01, 0.05, 0.02] + [1.0, 2.0, 3.0]
    up = upward(gravity)
    position, target = eye(vertices, up)
    ahead = (target - position) / np.linalg.norm(target - position)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    above = np.cross(right, ahead)
    seen = vertices - position
    depth = seen @ ahead
    assert depth.min() > 0.0
    slope = np.tan(0.5 * FIELD_OF_VIEW)
    high = np.abs(seen @ above) / depth / slope
    wide = np.abs(seen @ right) / depth / (slope * ASPECT)
    assert high.max() < 1.0
    assert wide.max() < 1.0
    # And not from far away.
    assert max(high.max(), wide.max()) > 0.8


def test_recordings_of_different_vessels_share_no_camera(simulation: Any) -> None:
    """Viewers keep camera and title by the application's id."""
    names = {application_of(simulation)}
    for change in ({"name": "other"}, {"title": "Another"}, {"gravity": (0.0, -9.81, 0.0)}):
        other = FakeSimulation()
        other.scene = msgspec.structs.replace(other.scene, **change)
        names.add(application_of(other))  # type: ignore[arg-type]
    moved = FakeSimulation()
    moved.vessel = SimpleNamespace(vertices=2.0 * np.asarray(moved.vessel.vertices))  # type: ignore[assignment]
    names.add(application_of(moved))  # type: ignore[arg-type]
    assert len(names) == 5
    assert application_of(FakeSimulation()) == application_of(simulation)  # type: ignore[arg-type]


def test_dyed_blood_has_the_colour_of_the_dye_as_far_as_it_is_dyed(
    simulation: Any, tmp_path: Path
) -> None:
    file = tmp_path / "run.rrd"
    simulation.dye[:3] = 1.0, 0.5, 0.0
    drive(simulation, [RerunView(simulation, file)], until=0.01, frame_interval=0.01)
    colours = unpacked(rows(file, "/world/blood", "Points3D:colors")[1])
    at_speed = of_speed(simulation).astype(float)
    np.testing.assert_array_equal(colours[0], DYE_COLOUR)
    np.testing.assert_allclose(colours[1], 0.5 * (at_speed[1] + DYE_COLOUR), atol=0.5)
    np.testing.assert_array_equal(colours[2:], at_speed[2:])
