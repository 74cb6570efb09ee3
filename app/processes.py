"""Work in processes of its own: Taichi frees no field."""

import multiprocessing
from collections.abc import Callable
from typing import Any


def in_own_process(work: Callable[..., Any], *args: Any) -> Any:
    """Result of a function called in a fresh process."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(work, args)
