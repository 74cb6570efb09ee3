"""Waveforms: the built-in one against its harmonics, files, and what is wrong with them."""

import math
from pathlib import Path

import numpy as np
import pytest

from taichi_sph.errors import InputError
from taichi_sph.waveform import (
    COMMON_CAROTID,
    COMMON_CAROTID_MEAN,
    COMMON_CAROTID_PERIOD,
    STEADY,
    common_carotid,
    read_waveform,
)

HARMONICS = np.arange(1, len(COMMON_CAROTID) + 1)
CHORD = 5e-3
"""Time between the points of the built-in waveform [s]."""


def carotid(time: np.ndarray, derivative: int = 0) -> np.ndarray:
    """Flow over its mean, or a derivative of it, by the sum of harmonics."""
    amplitude, shift = np.array(COMMON_CAROTID).T
    frequency = 2.0 * math.pi / COMMON_CAROTID_PERIOD * HARMONICS
    turn = np.outer(time, frequency) + shift + 0.5 * math.pi * derivative
    flow = np.sin(turn) @ (amplitude * frequency**derivative) / COMMON_CAROTID_MEAN
    return flow if derivative else 1.0 + flow


FIXED_POINT_SCALE = np.linspace(0.0, COMMON_CAROTID_PERIOD, 20_001)
STRAIGHT = CHORD**2 / 8.0 * float(np.abs(carotid(FIXED_POINT_SCALE, 2)).max())
"""How far a chord can be from its arc."""


def test_the_chords_of_the_carotid_are_as_near_to_the_arc_as_its_curvature_says():
    assert np.diff(common_carotid().time) == pytest.approx(CHORD)
    assert STRAIGHT < 0.02
    factor = [common_carotid()(t) for t in FIXED_POINT_SCALE]
    np.testing.assert_allclose(factor, carotid(FIXED_POINT_SCALE), rtol=0, atol=STRAIGHT)


def test_the_carotid_is_one_on_average_over_its_period():
    wave = common_carotid()
    # Straight lines: the trapezoidal rule is exact, and on even points keeps harmonics at zero.
    mean = np.trapezoid(wave.factor, wave.time) / COMMON_CAROTID_PERIOD
    assert mean == pytest.approx(1.0, abs=1e-12)


def test_the_carotid_peaks_at_twice_its_mean_early_in_the_beat():
    wave = common_carotid()
    exact = carotid(FIXED_POINT_SCALE)
    assert wave.factor.max() == pytest.approx(exact.max(), abs=STRAIGHT)
    at = wave.time[wave.factor.argmax()]
    assert at == pytest.approx(FIXED_POINT_SCALE[exact.argmax()], abs=CHORD)
    # What the benchmark's figure shows: some 13 ml/s within the first fifth of a beat; never back.
    assert 12.5 < wave.factor.max() * COMMON_CAROTID_MEAN < 14.0
    assert 0.1 < at < 0.22
    assert wave.factor.min() > 0.5


@pytest.mark.parametrize("beats", [1, 7, 1000])
def test_the_carotid_repeats(beats):
    wave = common_carotid()
    for time in (0.0, 0.1, 0.195, 0.77):
        # 1000 periods on, time has lost four digits; the wave's slope is 30 1/s at most.
        assert wave(time + beats * COMMON_CAROTID_PERIOD) == pytest.approx(wave(time), abs=1e-9)
    assert wave.factor[0] == pytest.approx(wave.factor[-1], abs=1e-12)


def write(folder: Path, content: str | bytes) -> str:
    data = content.encode() if isinstance(content, str) else content
    (folder / "beat.csv").write_bytes(data)
    return "beat.csv"


@pytest.mark.parametrize(
    "text",
    [
        "0,1\n0.25,3\n1,0.5\n",
        "time [s],factor\n0,1\n0.25,3\n1,0.5\n",
        "# of a dog\n0.0, 1.0\n# systole\n\n0.25, 3.0\n1.0, 0.5\n",
        "# of a dog\r\ntime,factor\r\n0,1\r\n0.25,3\r\n1,5e-1\r\n",
        '"time","factor"\n"0","1"\n"0.25","3"\n"1","0.5"',
    ],
    ids=["numbers alone", "titles", "comments", "of Windows", "quoted"],
)
def test_a_file_is_straight_between_its_rows_and_repeats(tmp_path, text):
    wave = read_waveform(write(tmp_path, text), tmp_path)
    for time, factor in ((0.0, 1.0), (0.125, 2.0), (0.25, 3.0), (0.5, 3.0 - 2.5 / 3.0)):
        for beat in range(3):
            assert wave(time + beat) == pytest.approx(factor, abs=1e-12)


def test_factors_may_be_negative(tmp_path):
    wave = read_waveform(write(tmp_path, "0,1\n1,-3\n"), tmp_path)
    assert wave(0.5) == -1.0


def test_nothing_given_is_steady_and_a_name_is_built_in(tmp_path):
    assert read_waveform(None, tmp_path) is STEADY
    assert {STEADY(time) for time in (0.0, 0.3, 1.0, 1e6)} == {1.0}
    named = read_waveform("common_carotid", tmp_path)
    np.testing.assert_array_equal(named.factor, common_carotid().factor)


NO_WAVEFORM = (
    "not a waveform; allowed: two rows or more of time [s] and factor, finite, "
    "the times ascending from 0"
)
# What is in the file, what the user reads after its path.
BAD: dict[str, tuple[str | bytes, str]] = {
    "empty": ("", NO_WAVEFORM),
    "comments alone": ("# nothing yet\n", NO_WAVEFORM),
    "titles alone": ("time,factor\n", NO_WAVEFORM),
    "one row": ("0,1\n", NO_WAVEFORM),
    "not ascending": ("0,1\n0.5,2\n0.4,1\n", NO_WAVEFORM),
    "the same time twice": ("0,1\n0.5,2\n0.5,1\n1,1\n", NO_WAVEFORM),
    "not from zero": ("0.1,1\n0.5,2\n", NO_WAVEFORM),
    "before zero": ("-0.5,1\n0,2\n1,1\n", NO_WAVEFORM),
    "no number": ("0,1\n0.5,nan\n1,1\n", NO_WAVEFORM),
    "a time that is none": ("0,1\nnan,2\n1,1\n", NO_WAVEFORM),
    "infinite": ("0,1\n0.5,inf\n1,1\n", NO_WAVEFORM),
    "text": ("0,1\n0.5,much\n1,1\n", "row 2 is '0.5,much'; allowed: time [s], factor"),
    "three columns": ("0,1,2\n1,1,2\n", "row 2 is '1,1,2'; allowed: time [s], factor"),
    "one column": ("0\n1\n", "row 2 is '1'; allowed: time [s], factor"),
    "semicolons": ("0;1\n1;1\n", "row 2 is '1;1'; allowed: time [s], factor"),
    "prose": ("Dear Sir\nor Madam\n", "row 2 is 'or Madam'; allowed: time [s], factor"),
    "binary": (
        b"PK\x03\x04\xff\xfe\x80\n\x81",
        "cannot read the waveform: not a CSV file; built in is common_carotid",
    ),
    "of zeros": (bytes(64), NO_WAVEFORM),
    "one endless cell": (
        "0" * 200_000,
        "cannot read the waveform: not a CSV file; built in is common_carotid",
    ),
}


@pytest.mark.parametrize("mistake", BAD)
def test_a_bad_file_is_one_sentence(tmp_path, mistake):
    content, message = BAD[mistake]
    with pytest.raises(InputError) as error:
        read_waveform(write(tmp_path, content), tmp_path)
    assert str(error.value) == f"{tmp_path / 'beat.csv'}: {message}"


def test_a_long_bad_row_is_cut(tmp_path):
    with pytest.raises(InputError) as error:
        read_waveform(write(tmp_path, "0,1\n" + "x" * 5000 + "\n"), tmp_path)
    assert len(str(error.value)) < len(str(tmp_path)) + 150


@pytest.mark.parametrize(
    ("given", "reason"),
    [("none.csv", "No such file or directory"), (".", "Is a directory")],
)
def test_a_file_that_cannot_be_read_is_one_sentence_that_says_what_is_built_in(
    tmp_path, given, reason
):
    with pytest.raises(InputError) as error:
        read_waveform(given, tmp_path)
    expected = f"cannot read the waveform: {reason}; built in is common_carotid"
    assert str(error.value) == f"{tmp_path / given}: {expected}"


def test_a_file_as_excel_writes_it_begins_with_a_mark_that_is_no_number(tmp_path):
    wave = read_waveform(write(tmp_path, b"\xef\xbb\xbf0,1\r\n1,3\r\n"), tmp_path)
    assert wave(0.5) == 2.0
