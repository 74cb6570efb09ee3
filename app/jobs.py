"""Work in processes of its own: Taichi frees no field."""

import multiprocessing
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any


def in_own_process(work: Callable[..., Any], *args: Any) -> Any:
    """Result of a function called in a fresh process, which may start processes itself.

    Raises:
        RuntimeError: the process ended without a result; and whatever the function raises.
    """
    context = multiprocessing.get_context("spawn")
    receiving, sending = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(sending, work, args))
    process.start()
    sending.close()
    try:
        result, error = receiving.recv()
    except EOFError:
        process.join()
        raise RuntimeError(
            f"the process for {work.__name__} ended with code {process.exitcode}"
        ) from None
    finally:
        process.terminate()
        process.join()
    if error is not None:
        raise error
    return result


def _answer(sending: Connection, work: Callable[..., Any], args: tuple[Any, ...]) -> None:
    try:
        sending.send((work(*args), None))
    except Exception as error:
        sending.send((None, error))
