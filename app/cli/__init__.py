"""The command line: it parses, calls one function, and turns errors into one sentence."""

import _thread
import logging
import os
import signal
import sys
import threading
from collections.abc import Sequence
from types import FrameType
from typing import NoReturn

import click

from app import version
from app.cli import measure, run, scenes, studies, training
from app.cli.ending import leave
from taichi_sph.errors import InputError, RunError

EPILOG = (
    "All quantities are in SI units. Exit codes: 0 done, 1 the run diverged or `validate` found a "
    "miss that is not known, 2 wrong input or a full disk, 130 and 143 stopped by a signal."
)


def print_version(context: click.Context, _: click.Parameter, asked: bool) -> None:
    """Answer --version."""
    if asked:
        click.echo(f"vesselflow {version()}")
        context.exit()


@click.group(epilog=EPILOG, context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=print_version,
    help="Print the version and leave.",
)
def cli() -> None:
    """Blood in vessels by smoothed particle hydrodynamics.

    SCENE is the name of a shipped scene (see `vesselflow scenes`), a scene's .toml file, or the
    folder of one.
    """


for command in (
    run.run, run.replay, scenes.scenes, scenes.info, scenes.new, training.record, training.train,
    training.ladder, studies.compare, studies.chart, studies.stability, studies.advise,
    measure.validate, measure.bench,
):  # fmt: skip
    cli.add_command(command)


class Stages(logging.Handler):
    """What is done to a large surface, line by line on stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        """Show one line."""
        from rich.console import Console

        console = Console(file=sys.stderr, highlight=False, markup=False)
        console.print(record.getMessage(), style="dim", soft_wrap=True)


class _Terminated(BaseException):
    """SIGTERM came outside a run, which ends in its own way."""


AFTER_IMPORT = 0.1
"""Wall time after which a signal that came during an import comes again [s]."""


def _is_importing(frame: FrameType | None) -> bool:
    """Whether a module is being imported."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def on_signal(number: int, frame: FrameType | None) -> None:
    """End the command by an exception; after an import, where Taichi would swallow it."""
    if _is_importing(frame):
        again = threading.Timer(AFTER_IMPORT, _thread.interrupt_main, [number])
        again.daemon = True
        again.start()
        return
    raise _Terminated if number == signal.SIGTERM else KeyboardInterrupt


def one_sentence(error: OSError) -> str:
    """An operating-system error as its file and reason."""
    if error.strerror is None:
        return str(error)
    return f"{error.filename}: {error.strerror}" if error.filename else error.strerror


def invoke(arguments: Sequence[str] | None) -> tuple[str, int]:
    """Run the command; the message to end with, if any, and the exit code."""
    try:
        code = cli.main(arguments, prog_name="vesselflow", standalone_mode=False)
        sys.stdout.flush()
        return "", code if isinstance(code, int) else 0
    except InputError as error:
        return str(error), 2
    except RunError as error:
        return str(error), 1
    except BrokenPipeError:
        # Who read the output has had enough, as in `vesselflow scenes | head -1`.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return "", 1
    except OSError as error:
        return one_sentence(error), 2
    except click.ClickException as error:
        return error.format_message(), error.exit_code
    except (click.Abort, KeyboardInterrupt):
        return "stopped by SIGINT", 130
    except _Terminated:
        return "stopped by SIGTERM", 143


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """The command `vesselflow`."""
    # Before Taichi's import: no banner, and no question to its server for a newer version.
    os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
    os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")
    # A terminal that lacks a letter shows its number; it ends no run.
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    log = logging.getLogger("taichi_sph")
    log.handlers, log.propagate = [Stages()], False
    log.setLevel(logging.INFO)
    # Taichi would import them, seconds long, for arrays that nobody here hands it.
    os.environ.setdefault("TI_ENABLE_TORCH", "0")
    os.environ.setdefault("TI_ENABLE_PADDLE", "0")
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    leave(*invoke(arguments))
