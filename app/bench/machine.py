"""What figures were measured on."""

import os
import platform
import subprocess
from pathlib import Path
from typing import Any


def describe_machine(arch: str, threads: int | None) -> dict[str, Any]:
    """What the figures were measured on."""
    model = platform.processor()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [
            s
            for s in cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines()
            if s.startswith("model name")
        ]
        model = names[0].partition(":")[2].strip() if names else model
    import taichi

    return {
        "processor": model,
        "cores": os.cpu_count(),
        "threads": threads or os.cpu_count(),
        "arch": arch,
        "precision": "f32",
        "python": platform.python_version(),
        "taichi": ".".join(map(str, taichi.__version__)),
        "commit": commit(),
    }


def commit() -> str:
    """Commit of the source tree; empty of an installed package."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    try:
        return subprocess.run(command, capture_output=True, text=True).stdout.strip()
    except OSError:
        return ""
