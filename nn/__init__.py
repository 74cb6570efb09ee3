"""The learned acceleration; it may import taichi_sph, never app."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nn.pcnet import load_pcnet as load_pcnet

__all__ = ["load_pcnet"]


def __getattr__(name: str) -> Any:
    """Import the public name when it is asked for: a dataset is read without Taichi."""
    if name != "load_pcnet":
        raise AttributeError(f"module 'nn' has no attribute {name!r}")
    return import_module("nn.pcnet").load_pcnet
