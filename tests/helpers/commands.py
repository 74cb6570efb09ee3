"""The command as a user runs it, in a folder of its own."""

import os
import subprocess
import sys
from pathlib import Path

from places import ROOT

HERE = os.environ | {"PYTHONPATH": str(ROOT)}


def vesselflow(folder: Path, *arguments: object, code: int = 0) -> str:
    """Standard error of the command, run in a folder."""
    command = [sys.executable, "-m", "app", *map(str, arguments)]
    done = subprocess.run(command, cwd=folder, env=HERE, capture_output=True, text=True)
    assert done.returncode == code, done.stderr
    return done.stderr
