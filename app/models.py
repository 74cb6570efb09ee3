"""Models by name: what `--model` takes, and what is compared."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

if TYPE_CHECKING:
    from taichi_sph.scene import Scene
    from taichi_sph.simulation import ModelFactory

Model = Literal["physics", "implicit", "pcnet"]
"""Name of a model."""
MODELS: tuple[str, ...] = get_args(Model)


def model_factory(
    name: str, scene: "Scene", weights: Path | None = None, guarded: bool = True
) -> "ModelFactory":
    """What makes a model for a scene.

    Args:
        name: one of MODELS.
        scene: the scene.
        weights: of pcnet; as `weights_for` by default.
        guarded: whether the physics stands in for a direct head that runs away.

    Raises:
        InputError: weights that cannot be read.
    """
    if name == "pcnet":
        from app.scenes.library import weights_for
        from nn.pcnet import load_pcnet

        return load_pcnet(weights or weights_for(scene), scene, guarded)
    from taichi_sph.models import implicit, physics

    return implicit(scene) if name == "implicit" else physics(scene)
