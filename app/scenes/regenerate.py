"""The shipped lumen surfaces, made again: python -m app.scenes.regenerate [NAME ...]."""

import sys
import time
from pathlib import Path

from app.scenes.centreline import remake
from taichi_sph.errors import InputError

VESSELS = Path(__file__).resolve().parents[2] / "assets" / "vessels"


def main(names: list[str]) -> int:
    """Make the named vessels, or all that have a table; return the exit code."""
    known = sorted(path.parent.name for path in VESSELS.glob("*/centreline.json"))
    for name in names or known:
        if name not in known:
            print(f"{name}: no such vessel; allowed: {', '.join(known)}", file=sys.stderr)
            return 2
        begin = time.perf_counter()
        try:
            triangles, volume = remake(VESSELS / name)
        except InputError as error:
            print(error, file=sys.stderr)
            return 2
        wall_time = time.perf_counter() - begin
        print(f"{name}: {triangles} triangles, {volume * 1e6:.4g} ml, {wall_time:.1f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
