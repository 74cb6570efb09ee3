"""State: all of a simulation that changes from step to step, as a checkpoint keeps it."""

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class State:
    """All that changes from step to step; rows in the order of the grid."""

    time: float
    """[s]"""
    last_step: float
    """[s]"""
    fallback_time: float
    """[s]"""
    steps: int
    wall_corrections: int
    model: str
    """Name of the model."""
    gravity: tuple[float, float, float]
    """[m/s^2]"""
    boundaries: dict[str, dict[str, Any]]
    """What each boundary's `save_state` gave, by its name."""
    particles: dict[str, np.ndarray]
    """Each quantity by name, (n,) or (n, 3)."""
