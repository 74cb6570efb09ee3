"""What drives the blood is said, and what no vessel has is asked about."""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from app.cli import invoke
from app.scenes.driving import driving
from app.scenes.library import shipped
from taichi_sph.scene import read_scene

SCENE = """
title = "Tube"
duration = 0.1
frame_interval = 0.01
gravity = [0.0, 0.0, 0.0]
[vessel]
surface = "{surface}"
[openings.top]
centre = [0.0, 0.0, 0.03]
{top}
[openings.bottom]
centre = [0.0, 0.0, -0.03]
{bottom}
[column]
opening = "top"
height = 0.01
[discretization]
spacing = 1e-3
"""
RADIUS = 4e-3
BEAT = "time,factor\n0,1\n0.2,2\n0.4,1.2\n0.8,1\n"
MEAN = (0.2 * 1.5 + 0.2 * 1.6 + 0.4 * 1.1) / 0.8


def scaled(time: float, factor: float) -> str:
    rows = [(0.0, 1.0), (0.2, 2.0), (0.4, 1.2), (0.8, 1.0)]
    return "".join(f"{time * t},{factor * f}\n" for t, f in rows)


def found(folder: Path, top: str, bottom: str = "", beat: str = BEAT) -> dict[str, Any]:
    (folder / "beat.csv").write_text(beat)
    text = SCENE.format(surface="lumen.ply", top=top, bottom=bottom)
    (folder / "scene.toml").write_text(text)
    area = math.pi * RADIUS**2
    openings = [SimpleNamespace(name=name, area=area) for name in ("top", "bottom")]
    vessel: Any = SimpleNamespace(openings=openings)
    return {drive.name: drive for drive in driving(read_scene(folder / "scene.toml"), vessel)}


PUMP = 'flow = 5e-6\nwaveform = "beat.csv"'
RESERVOIR = 'pressure = 12400.0\nwaveform = "beat.csv"'


def test_a_pump_and_a_reservoir_are_said_in_si_units(tmp_path: Path) -> None:
    drives = found(tmp_path, PUMP, "pressure = 12400.0")
    mean = 5e-6 * MEAN
    assert drives["top"].text == (f"pump, {mean:.4g} m^3/s on average, at most 1e-05, period 0.8 s")
    assert drives["bottom"].text == "reservoir, 12400 Pa (93 mmHg), steady"
    assert not drives["top"].questions and not drives["bottom"].questions
    assert found(tmp_path, 'state = "open"') == {}


QUESTIONS = {
    "milliseconds": (PUMP, "", scaled(1e3, 1.0), "repeats every 800 s"),
    "minutes": (PUMP, "", scaled(1.0 / 60.0, 1.0), "no heart beats so fast"),
    "milliseconds at a reservoir": (RESERVOIR, "", scaled(1e3, 1.0), "repeats every 800 s"),
    "ml/s for m^3/s": ("flow = 5.0", "", BEAT, "faster than blood flows"),
    "l/min for m^3/s": ("flow = 0.3", "", BEAT, "is the flow in m^3/s"),
    "m^3/s in the file too": (PUMP, "", scaled(1.0, 5e-6), "next to nothing"),
    "a flow for a factor": (PUMP, "", scaled(1.0, 6.0), "it is a factor"),
    "a pressure for a factor": (RESERVOIR, "", scaled(1.0, 1e-3), "it is a factor"),
    "no mean": (PUMP, "", "0,1\n0.5,-1\n1,1\n", "its mean is zero"),
    "a reservoir without a mean": (RESERVOIR, "", "0,1\n0.5,-1\n1,1\n", "its mean is zero"),
    "the other sign": ("flow = -5e-6", "pressure = 0.0", BEAT, "its mean is negative"),
    "dyn/cm^2 for Pa": ("pressure = 124000.0", "", BEAT, "930 mmHg, above any artery's"),
    "a peak above any artery's": (
        'pressure = 30000.0\nwaveform = "beat.csv"', "", BEAT, "above any artery's",
    ),
    "a vacuum": ("pressure = -20000.0", "", BEAT, "stronger than suction pumps draw"),
}  # fmt: skip


@pytest.mark.parametrize("case", QUESTIONS)
def test_what_no_vessel_has_is_asked_about(case: str, tmp_path: Path) -> None:
    top, bottom, beat, part = QUESTIONS[case]
    questions = found(tmp_path, top, bottom, beat)["top"].questions
    assert any(part in question for question in questions), questions
    assert all("\n" not in question for question in questions)


@pytest.mark.parametrize(
    ("top", "bottom"),
    [
        ('flow = 2.2e-5\nwaveform = "common_carotid"', "pressure = 12400.0"),
        ("flow = 5e-6", "flow = -5e-6"),  # what one pump brings another takes
        ("flow = 0.0", "pressure = 0.0"),  # shut, and open to the outside
        (PUMP, "pressure = -1000.0"),
    ],
)
def test_what_vessels_have_is_not_asked_about(top: str, bottom: str, tmp_path: Path) -> None:
    assert not any(drive.questions for drive in found(tmp_path, top, bottom).values())


def test_no_shipped_scene_is_asked_about() -> None:
    from taichi_sph.geometry.vessel import read_vessel

    for name in ("aorta_surgery", "carotid_surgery"):
        scene = read_scene(shipped()[name])
        drives = driving(scene, read_vessel(scene))
        assert len(drives) == 3
        assert not any(drive.questions for drive in drives)


def test_the_mean_is_that_of_the_curve(tmp_path: Path) -> None:
    from taichi_sph.waveform import read_waveform

    (tmp_path / "beat.csv").write_text(BEAT)
    wave = read_waveform("beat.csv", tmp_path)
    times = np.linspace(0.0, 0.8, 80_001)
    # Straight between its points, so that the rule errs by a corner's share of a step.
    assert wave.mean == pytest.approx(np.mean([wave(t) for t in times[:-1]]), rel=1e-4)
    assert (wave.period, wave.least, wave.most) == (0.8, 1.0, 2.0)


def test_info_says_what_drives_the_blood_and_asks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "slow.csv").write_text(scaled(1e3, 1.0))
    source = shipped()["tube"]
    surface = (source.parent / "lumen.ply").as_posix()
    text = source.read_text().replace('"lumen.ply"', f'"{surface}"')
    scene = read_scene(source)
    opening = next(iter(scene.openings))
    text = text.replace(f"[openings.{opening}]", f'[openings.{opening}]\nflow = 5e-6\n'
                        'waveform = "slow.csv"')  # fmt: skip
    (tmp_path / "scene.toml").write_text(text)
    assert invoke(["info", str(tmp_path)]) == ("", 0)
    out = capsys.readouterr().out
    assert f"{opening} " in out and "period 800 s" in out
    assert "repeats every 800 s" in out
