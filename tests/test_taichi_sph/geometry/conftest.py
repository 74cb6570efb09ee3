"""A vessel that many tests ask of, and a cache of their own."""

from pathlib import Path

import pytest

from places import VESSELS
from taichi_sph.geometry.vessel import Vessel, read_vessel
from taichi_sph.scene import read_scene


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No test reads or writes the user's cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "vesselflow"


@pytest.fixture(scope="session")
def aorta() -> Vessel:
    return read_vessel(read_scene(VESSELS / "aortoiliac" / "scene.toml"))
