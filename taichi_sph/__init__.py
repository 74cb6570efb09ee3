"""SPH for blood in a vessel, on Taichi."""

from importlib import import_module
from typing import Any

_HOMES = {
    "InputError": "errors",
    "RunError": "errors",
    "Scene": "scene",
    "Simulation": "simulation",
    "read_scene": "scene",
    "start": "runtime",
}
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    """Import a public name when it is asked for: listing scenes needs no Taichi."""
    if name not in _HOMES:
        raise AttributeError(f"module 'taichi_sph' has no attribute {name!r}")
    return getattr(import_module(f"taichi_sph.{_HOMES[name]}"), name)
