"""Where things are: the source tree, the shipped vessels, the files shared beside it."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
VESSELS = ROOT / "assets" / "vessels"
SHARED = ROOT.parent / "shared"
