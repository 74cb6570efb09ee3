"""ModelSelection: the models of a session, which of them computes, and the choice of `auto`."""

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

from app.models import MODELS, model_factory
from app.scenes.library import weights_for
from taichi_sph.errors import InputError
from taichi_sph.scene_files import file_hash

if TYPE_CHECKING:
    from taichi_sph.diagnostics import Diagnostics
    from taichi_sph.fluid.model import AccelerationModel
    from taichi_sph.simulation import Simulation

AUTO = "auto"
AUTO_MODELS = ("pcnet", "implicit")
"""What `auto` chooses from: the network, and what stands in for it."""
COMPRESSION_HIGH, COMPRESSION_LOW = 0.08, 0.04
"""`auto` leaves PcNet where the 99th percentile of compression is above the first, for what its
training saw is below, and comes back below the second."""


class ModelSelection:
    """Models that a session may switch between."""

    def __init__(
        self,
        simulation: "Simulation",
        needed: Collection[str] = (),
        offered: Collection[str] = (),
        weights: Path | None = None,
    ):
        """Make the models and compile them, before anybody waits for it.

        Args:
            simulation: at its start; its own model is ready.
            needed: names of models without which the session cannot be.
            offered: names of models that are left out where they do not fit the scene.
            weights: file of the network's weights; the scene's, or the aorta's, by default.

        Raises:
            InputError: a model that is needed cannot be made.
        """
        self._simulation = simulation
        self.ready: dict[str, AccelerationModel] = {simulation.model.name: simulation.model}
        self._reasons: dict[str, str] = {}
        """Why a model is not ready, by name."""
        if AUTO in needed:
            needed = {*needed, *AUTO_MODELS}
        for name in MODELS:
            if name in (*needed, *offered) and name not in self.ready:
                try:
                    factory = model_factory(name, simulation.scene, weights)
                    self.ready[name] = simulation.make_model(factory)
                except InputError as error:
                    if name in needed:
                        raise
                    self._reasons[name] = str(error)
        simulation.compile_kernels(list(self.ready.values()))
        self.auto = False
        """Whether the choice is left to the compression of the blood."""
        self._auto_until = self._auto_time = self._fallback_time = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names that may be selected, `auto` among them where it has what it chooses from."""
        return (*self.ready, *([AUTO] if self.ready.keys() >= set(AUTO_MODELS) else []))

    @property
    def selected(self) -> str:
        """Name of what was selected: a model's, or `auto`."""
        return AUTO if self.auto else self._simulation.model.name

    def check(self, name: str) -> None:
        """Refuse a model that is not ready.

        Raises:
            InputError: why it is not, and which are.
        """
        if name not in self.names:
            wanted = AUTO_MODELS if name == AUTO else (name,)
            reasons = [self._reasons[model] for model in wanted if model in self._reasons]
            why = "".join(f": {reason}" for reason in reasons)
            allowed = ", ".join(self.names)
            raise InputError(f"model: {name!r} is not ready{why}; allowed: {allowed}")

    def select(self, name: str) -> None:
        """Let a model compute from now on, or leave the choice to `auto`, which begins with pcnet.

        Raises:
            InputError: it is not ready.
        """
        self.check(name)
        self.auto = name == AUTO
        self._auto_until, self._auto_time = self._simulation.time, 0.0
        self._fallback_time = 0.0
        self._simulation.use_model(self.ready[AUTO_MODELS[0] if self.auto else name])

    def choose(self, compression: float) -> str | None:
        """Let `auto` choose by the 99th percentile of compression; the name of a new choice."""
        if not self.auto:
            return None
        network, fallback = AUTO_MODELS
        name = self._simulation.model.name
        if compression > COMPRESSION_HIGH:
            name = fallback
        elif compression < COMPRESSION_LOW:
            name = network
        if name == self._simulation.model.name:
            return None
        self._simulation.use_model(self.ready[name])
        return name

    def fallback_fraction(self, diagnostics: "Diagnostics") -> float:
        """Part of the time in which something else stood in for the network; ask once a frame."""
        if not self.auto:
            return diagnostics.fallback_share
        passed, self._auto_until = diagnostics.time - self._auto_until, diagnostics.time
        self._auto_time += passed
        self._fallback_time += passed * (self._simulation.model.name != AUTO_MODELS[0])
        return self._fallback_time / self._auto_time if self._auto_time > 0.0 else 0.0


def network_metadata(simulation: "Simulation", weights: Path | None) -> dict[str, str]:
    """Weights of a session's network, for its log: the file and the hash of its content."""
    file = (weights or weights_for(simulation.scene)).resolve()
    return {"file": str(file), "hash": file_hash(file)}
