"""Rows and curves of `vesselflow validate`: what was computed beside what theory says."""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from taichi_sph.simulation import Simulation


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    quantity: str
    computed: str
    theory: str
    error: float
    """Relative, unless the quantity says otherwise."""
    tolerance: float
    seconds: float
    """Wall time since the row before."""
    known: str = ""
    """Why it is known to miss; empty of a row that should pass."""

    @property
    def passed(self) -> bool:
        """Whether the error is within the tolerance; a NaN is not."""
        return self.error <= self.tolerance

    @property
    def as_json(self) -> dict[str, Any]:
        """What `validate --json` keeps of it."""
        return asdict(self) | {"passed": self.passed}

    @property
    def verdict(self) -> str:
        """What the table says of it."""
        if self.passed:
            return "pass"
        return "known miss" if self.known else "MISS"


@dataclass(frozen=True)
class Curve:
    """A computed profile beside theory, for a picture."""

    label: str
    x: np.ndarray
    computed: np.ndarray
    theory_x: np.ndarray
    theory: np.ndarray
    source: str = "theory"
    """What it is held against."""


class Report:
    """Where a case puts its rows and curves, and says how far it is."""

    def __init__(self, advance: Callable[[float], None]):
        """`advance` is told the fraction of the case that is done."""
        self.advance = advance
        self.rows: list[Row] = []
        self.pictures: dict[str, tuple[str, str, list[Curve]]] = {}
        self._since = time.perf_counter()

    def add(
        self,
        quantity: str,
        computed: str,
        theory: str,
        error: float,
        tolerance: float,
        known: str = "",
    ) -> None:
        """Add a row; its wall time is the time since the last."""
        now = time.perf_counter()
        row = Row(quantity, computed, theory, float(error), tolerance, now - self._since, known)
        self.rows.append(row)
        self._since = now

    def compare(
        self,
        quantity: str,
        computed: float,
        theory: float,
        tolerance: float,
        unit: str = "",
        known: str = "",
    ) -> None:
        """Add a row of two numbers with their relative difference."""
        self.add(
            quantity, f"{computed:.5g} {unit}".strip(), f"{theory:.5g} {unit}".strip(),
            abs(computed / theory - 1.0), tolerance, known,
        )  # fmt: skip

    def draw(self, picture: str, x_label: str, y_label: str, curve: Curve) -> None:
        """Keep a curve for a picture of this name."""
        self.pictures.setdefault(picture, (x_label, y_label, []))[2].append(curve)


def relative_l2(computed: np.ndarray, theory: np.ndarray) -> float:
    """sqrt(sum (a - b)^2 / sum b^2) over all particles; nothing averaged, nothing left out."""
    return math.sqrt(np.square(computed - theory).sum() / np.square(theory).sum())


def watched(
    motion: Simulation,
    times: list[float],
    report: Report,
    begin: float,
    end: float,
    axial_force: Callable[[float], float] | None = None,
) -> Iterator[int]:
    """Advance to each time, telling progress between two fractions; yields the index.

    A force per mass along z [m/s^2] that changes with time [s] is set before each step.
    """
    for k, target in enumerate(times):
        while motion.time < target * (1.0 - 1e-12):
            if axial_force is not None:
                motion.gravity = (0.0, 0.0, axial_force(motion.time))
            motion.step(target - motion.time)
            if motion.steps % 50 == 0:
                report.advance(begin + (end - begin) * motion.time / times[-1])
        motion.time = target
        yield k
