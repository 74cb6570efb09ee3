"""The end of the process."""

import os
import sys
from typing import NoReturn

import click


def leave(message: str, code: int, at_once: bool = False) -> NoReturn:
    """End the process; at once, if libraries would wait for somebody else at Python's exit."""
    if message:
        click.echo(message, err=True)
    if at_once:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)
