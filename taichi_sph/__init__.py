"""SPH for blood in a vessel, on Taichi: the public names.

An engine needs nothing else but `nn.load_pcnet`, the learned model: docs/engine.py is a loop.
"""

import os
import tempfile
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from taichi_sph.errors import InputError as InputError
    from taichi_sph.errors import RunError as RunError
    from taichi_sph.fluid.model import AccelerationModel as AccelerationModel
    from taichi_sph.models import implicit as implicit
    from taichi_sph.models import physics as physics
    from taichi_sph.runtime import float_dtype as float_dtype
    from taichi_sph.runtime import start as start
    from taichi_sph.scene import Scene as Scene
    from taichi_sph.scene import read_scene as read_scene
    from taichi_sph.simulation import Simulation as Simulation
    from taichi_sph.state import State as State

_HOMES = {
    "AccelerationModel": "fluid.model",
    "InputError": "errors",
    "RunError": "errors",
    "Scene": "scene",
    "Simulation": "simulation",
    "State": "state",
    "float_dtype": "runtime",
    "implicit": "models",
    "physics": "models",
    "read_scene": "scene",
    "start": "runtime",
}
__all__ = list(_HOMES)

if os.name != "nt" and not (os.environ.get("HOME") or os.environ.get("XDG_CACHE_HOME")):
    # Taichi aborts at its import where neither says whose cache is whose.
    _home = os.path.expanduser("~")
    os.environ["HOME"] = _home if os.path.isabs(_home) else tempfile.gettempdir()


def __getattr__(name: str) -> Any:
    """Import a public name when it is asked for: listing scenes needs no Taichi."""
    if name not in _HOMES:
        raise AttributeError(f"module 'taichi_sph' has no attribute {name!r}")
    return getattr(import_module(f"taichi_sph.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    """The public names, imported or not."""
    return sorted({*globals(), *_HOMES})
