"""Weights: raw arrays and what they were made for, in one `.npz`; needs no torch."""

import json
import zipfile
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nn.features import NAMES, TABLE_VERSION, Inputs
from taichi_sph.errors import InputError
from taichi_sph.fluid.model import Fluid
from taichi_sph.system import replaced

SCHEMA = 3
VISCOSITY_RATIO = "thickening"
"""Name of `Training.viscosity_ratio` in a weights file."""


@dataclass(frozen=True)
class Training:
    """What the network was trained on.

    The network itself is dimensionless: it serves any scene of the same `support_ratio`,
    `artificial_viscosity` and `viscosity_ratio`, with the step that its `courant_number` gives
    there.
    """

    head: str
    """"direct": the acceleration itself, as the paper; "pressure": see nn.pcnet."""
    inputs: tuple[str, ...]
    """Names of the features that it sees, of `nn.features.NAMES`."""
    spacing: float
    """d [m]."""
    support_radius: float
    """R [m]."""
    frame_interval: float
    """T, the step of the network [s]."""
    substeps: int
    """M: steps of the physics in T."""
    rounds: int
    """Jacobi iterations after the pressure head's initial pressure, see taichi_sph.fluid.implicit;
    none of the direct head."""
    sound_speed: float
    """c of the physics that made the data [m/s]."""
    wall_spacing_ratio: float
    artificial_viscosity: float
    """Monaghan's alpha of the physics that made the data."""
    viscosity_ratio: float
    """Viscosity at rest over that at high shear: 1 of a Newtonian liquid."""
    correction: str
    """"bp", "periodic" or "relabel"."""
    seed: int
    scene: str
    """Name of the training scene."""
    scene_hash: str
    """SHA-256 of the training scene's text."""
    table_version: int = TABLE_VERSION
    validation: dict[str, float] = field(default_factory=dict)
    """Figures of the rollout on the held-out height."""
    command: str = ""
    """What made the file."""

    @property
    def support_ratio(self) -> float:
        """R/d."""
        return self.support_radius / self.spacing

    @property
    def courant_number(self) -> float:
        """How far sound comes in a step of the network: c T/R."""
        return self.sound_speed * self.frame_interval / self.support_radius

    @property
    def columns(self) -> Inputs:
        """Where the inputs stand among all features."""
        return Inputs(tuple(NAMES.index(name) for name in self.inputs))


def dimensionless_numbers(fluid: Fluid) -> dict[str, float]:
    """The numbers of a liquid that a network depends on; see `Training`."""
    return {
        "artificial_viscosity": fluid.artificial_viscosity,
        "viscosity_ratio": fluid.rheology.largest_viscosity / fluid.rheology.eta,
    }


@dataclass(frozen=True, eq=False)
class Weights:
    """A multilayer perceptron with softsign, x/(1 + |x|), between its layers."""

    layers: tuple[tuple[np.ndarray, np.ndarray], ...]
    """(weight (out, in), bias (out,)) of each layer, f32."""
    mean: np.ndarray
    """Subtracted from the inputs, (in,)."""
    deviation: np.ndarray
    """Divides them, (in,); never zero."""
    scale: np.ndarray
    """Multiplies the outputs, (out,)."""
    training: Training

    @property
    def sizes(self) -> tuple[int, ...]:
        """Width of the input, of each hidden layer and of the output."""
        return (self.layers[0][0].shape[1], *(w.shape[0] for w, _ in self.layers))

    def evaluate(self, x: np.ndarray) -> np.ndarray:
        """The network in numpy: (n, in) dimensionless features -> (n, out)."""
        y = np.clip((x - self.mean) / self.deviation, -CLIP, CLIP)
        for k, (w, b) in enumerate(self.layers):
            y = y @ w.T + b
            if k + 1 < len(self.layers):
                y = y / (1.0 + np.abs(y))
        return y * self.scale

    def save(self, path: Path) -> None:
        """Write the file, whole or not at all."""
        training = asdict(self.training)
        training[VISCOSITY_RATIO] = training.pop("viscosity_ratio")
        arrays: dict[str, Any] = {
            "mean": self.mean,
            "deviation": self.deviation,
            "scale": self.scale,
            "schema": np.int64(SCHEMA),
            "training": np.str_(json.dumps(training)),
        }
        for k, (w, b) in enumerate(self.layers):
            arrays[f"weight_{k}"], arrays[f"bias_{k}"] = w, b
        with replaced(path) as file:
            np.savez(file, **arrays)

    @classmethod
    def load(cls, path: Path) -> "Weights":
        """Read the file.

        Raises:
            InputError: no such file, cut, or not weights of this version.
        """
        try:
            # Numpy leaves a file that it cannot read open; what is open here is closed here.
            with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
                if int(file["schema"]) != SCHEMA:
                    raise InputError(
                        f"{path}: weights of schema {int(file['schema'])}, this program reads "
                        f"{SCHEMA}; train them again"
                    )
                facts = json.loads(str(file["training"]))
                facts["inputs"] = tuple(facts["inputs"])
                facts["viscosity_ratio"] = facts.pop(VISCOSITY_RATIO)
                training = Training(**facts)
                training.columns  # noqa: B018  names of this program's table, or ValueError
                count = sum(name.startswith("weight_") for name in file.files)
                layers = tuple(
                    (file[f"weight_{k}"].astype(np.float32), file[f"bias_{k}"].astype(np.float32))
                    for k in range(count)
                )
                return cls(layers, file["mean"], file["deviation"], file["scale"], training)
        except InputError:
            raise
        except OSError as error:
            raise InputError(
                f"{path}: cannot read the weights: {error.strerror or error}"
            ) from None
        except (zipfile.BadZipFile, KeyError, ValueError, TypeError, EOFError):
            raise InputError(
                f"{path}: not a weights file of vesselflow, or a cut one; `vesselflow train` "
                "makes them"
            ) from None


CLIP = 5.0
"""Standardised inputs are held within this many deviations."""


def require_fit(weights: Weights, path: str, found: dict[str, float]) -> None:
    """Refuse weights that were trained for other proportions than the scene's.

    Args:
        weights: the weights.
        path: their file, for the message.
        found: the scene's value of each of TOLERANCE.

    Raises:
        InputError: names the field and both values.
    """
    if weights.training.table_version != TABLE_VERSION:
        raise InputError(
            f"{path}: table_version is {weights.training.table_version} in the weights, "
            f"{TABLE_VERSION} in this program; train them again"
        )
    for name, value in found.items():
        trained = getattr(weights.training, name)
        if abs(trained - value) > TOLERANCE[name] * max(abs(trained), abs(value)):
            raise InputError(
                f"{path}: {name} is {trained:.4g} in the weights, {value:.4g} in the scene, "
                f"allowed are {100 * TOLERANCE[name]:.3g} % of difference; "
                "train on this scene, or give it the weights' value"
            )


TOLERANCE = {"support_ratio": 1e-3, "artificial_viscosity": 1e-3, "viscosity_ratio": 0.5}
"""Relative.  Yield stresses of blood differ by more between people than by half (Merrill: 2 to
10 mPa), and hardly matter where it pours; a Newtonian liquid is refused where blood was learned."""
