"""Work in processes of its own: Taichi frees no field."""

import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any


def in_own_process(work: Callable[..., Any], *args: Any) -> Any:
    """Result of a function called in a fresh process, which may start processes itself."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(work, *args).result()
