"""Waveforms: what a flow or a pressure is multiplied by, over time, again and again."""

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from taichi_sph.errors import InputError

RAMP_TIME = 0.05
"""Time in which a flow, a pressure or a wall's motion rises from nothing to what is asked for [s]:
blood that is set going at once rings."""

COMMON_CAROTID = (
    (3.294, -0.023974), (1.9262, -1.1801), (-1.4219, 0.92701), (-0.66627, -0.24118),
    (-0.33933, -0.27471), (-0.37914, -1.0557), (0.22396, 1.22), (0.1507, 1.0984),
    (0.18735, 0.067483), (0.038625, 0.22262), (0.012643, -0.10093), (-0.0042453, -1.1044),
)  # fmt: skip
"""Amplitudes [ml/s] and phases [rad] of the first harmonics of the flow in a common carotid artery
whose mean is 6.5 ml/s and whose period is 1.1 s: the inflow of the benchmark by Boileau et al.
2015, doi:10.1002/cnm.2732.  The harmonics left out are below 0.25 % of the mean."""
COMMON_CAROTID_MEAN = 6.5
COMMON_CAROTID_PERIOD = 1.1


@dataclass(frozen=True, eq=False)
class Waveform:
    """A factor over time, straight between its points; it repeats after the last."""

    time: np.ndarray
    """From 0, ascending [s], (n,)."""
    factor: np.ndarray
    """[-], (n,)."""

    def __call__(self, time: float) -> float:
        """The factor at a time [s]."""
        return float(np.interp(time % float(self.time[-1]), self.time, self.factor))

    @property
    def period(self) -> float:
        """Time after which it repeats [s]."""
        return float(self.time[-1])

    @property
    def mean(self) -> float:
        """Mean factor over a period [-]."""
        return float(np.trapezoid(self.factor, self.time)) / self.period

    @property
    def least(self) -> float:
        """Smallest factor [-]."""
        return float(self.factor.min())

    @property
    def most(self) -> float:
        """Largest factor [-]."""
        return float(self.factor.max())

    @property
    def is_steady(self) -> bool:
        """Whether it never changes."""
        return self.least == self.most


STEADY = Waveform(np.array([0.0, 1.0]), np.array([1.0, 1.0]))


def common_carotid() -> Waveform:
    """The flow in a common carotid artery over its mean."""
    time = np.linspace(0.0, COMMON_CAROTID_PERIOD, 221)
    phase = 2.0 * math.pi * time / COMMON_CAROTID_PERIOD
    flow = np.full(len(time), COMMON_CAROTID_MEAN)
    for k, (amplitude, shift) in enumerate(COMMON_CAROTID, 1):
        flow += amplitude * np.sin(k * phase + shift)
    return Waveform(time, flow / COMMON_CAROTID_MEAN)


BUILT_IN = {"common_carotid": common_carotid}
"""Waveforms by name."""


def read_waveform(given: str | None, folder: Path) -> Waveform:
    """A built-in waveform by its name, one from a CSV file (time [s], factor), or none: steady.

    Raises:
        InputError: the file cannot be read, or its rows are no waveform.
    """
    if given is None:
        return STEADY
    if given in BUILT_IN:
        return BUILT_IN[given]()
    path = folder / given
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            lines = [
                (reader.line_num, line) for line in reader if line and not line[0].startswith("#")
            ]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or "not a CSV file"
        built_in = ", ".join(BUILT_IN)
        raise InputError(
            f"{path}: cannot read the waveform: {reason}; built in is {built_in}"
        ) from None
    rows = []
    for number, line in lines:
        try:
            time, factor = (float(cell) for cell in line)
        except ValueError:
            if (number, line) == lines[0]:
                continue  # titles
            raise InputError(
                f"{path}: row {number} is {','.join(line)[:60]!r}; allowed: time [s], factor"
            ) from None
        rows.append((time, factor))
    table = np.array(rows, dtype=float).reshape(-1, 2)
    whole = len(table) >= 2 and bool(np.isfinite(table).all())
    if not whole or table[0, 0] != 0.0 or (np.diff(table[:, 0]) <= 0.0).any():
        raise InputError(
            f"{path}: not a waveform; allowed: two rows or more of time [s] and factor, finite, "
            "the times ascending from 0"
        )
    return Waveform(table[:, 0], table[:, 1])
