"""What a file of recorded runs holds; no other room knows it.

A file holds `runs/0`, `runs/1`, ...: one run of the physics each, seen at frames T apart.  T is M
sub-steps of the scene's own step, so it is the step that a network learns to take.

| dataset | shape | unit | row f |
|---|---|---|---|
| position, velocity | (frames + 1, n, 3) | m, m/s | at t_f = f T; a particle keeps its column |
| alive | (frames + 1, n) | 1 | 0 once the particle has left the vessel |
| acceleration | (frames, n, 3) | m/s^2 | a_i^n of frame f: (v(t_f) - v(t_f - T))/T, 0 for f = 0 |
| target | (frames, n, 3) | m/s^2 | (v(t_f + T) - v(t_f))/T: what is to be learned |
| features | (frames, n, 23) | 1 | `nn.features` of frame f, with acceleration[f] as a_i |
| substep_count | (frames,) | 1 | steps that the physics took from t_f to t_f + T |
| substep_smallest, substep_largest | (frames,) | s | the least and the greatest of them |
| proxy_position, proxy_normal | (m, 3) | m, 1 | (no frames) normals point out of the lumen |
| proxy_volume | (m,) | m^3 | V_k of Eq. 3 |

So the target of frame f is the acceleration of frame f + 1, both are means over one frame
interval, and acceleration[f] is what a closed loop has as its previous acceleration.  The state
after the last frame is kept for its target.  Rows of particles that have left hold zeros; a
target exists where a particle is alive at both ends of the interval and is 0 elsewhere.
`target` and `features` are stored on demand; `Run.target` works the former out otherwise.

`files/0`, `files/1`, ... are what the scene names, byte by byte, with their `name` there: surface
and tool.  So a file says all that a training needs, wherever it lies.  Schema 1 had no files.

Numbers are stored as the simulation has them, in single precision; one chunk is one frame,
compressed, with a Fletcher-32 checksum.  `RunMetadata` lists the attributes of a run.  Split by
run, never by sample: neighbouring frames are nearly the same.
"""

import math
from dataclasses import MISSING, asdict, dataclass, fields
from typing import Any

import numpy as np

from taichi_sph.errors import InputError

SIGNATURE = b"\x89HDF\r\n\x1a\n"
"""How every HDF5 file begins."""
DATASET = "vesselflow dataset"
RUN_UNDER_WAY = "vesselflow run under way"
UNDER_WAY = f'{{"format": "{RUN_UNDER_WAY}"'.encode()
"""How the file of a run begins that is not finished."""
SCHEMA = 2
READABLE = (1, 2)
"""Schemas that this program reads."""


@dataclass(frozen=True)
class RunMetadata:
    """What a run is about: its attributes in the file, the same in every recording of it."""

    scene: str
    """TOML text of the scene; `height` replaces its column's."""
    scene_name: str
    scene_folder: str
    """Where the scene's relative paths started when it was recorded."""
    surface_sha256: str
    """Of the surface file."""
    program_version: str
    architecture: str
    """cpu or gpu."""
    seed: int
    height: float
    """Height of the blood column at the start [m]."""
    frames: int
    particles: int
    """Blood particles at the start, n."""
    spacing: float
    """d [m]."""
    support_radius: float
    """R [m]."""
    sound_speed: float
    """c [m/s]."""
    substep: float
    """The scene's step at its expected speed [s]; the physics takes shorter ones where it must."""
    substeps: int
    """M: sub-steps a frame where none had to be shorter."""
    frame_interval: float
    """T = M substep [s]."""
    feature_version: int
    """Version of the table of features; 0 if none are stored."""
    tool_sha256: str = ""
    """Of the tool's surface file; empty without a tool."""


UNITS = {
    "height": "m",
    "spacing": "m",
    "support_radius": "m",
    "sound_speed": "m/s",
    "substep": "s",
    "frame_interval": "s",
    "substep_smallest": "s",
    "substep_largest": "s",
}
"""Units of attributes, stored beside them as <name>_unit."""


@dataclass(frozen=True, eq=False)
class Proxies:
    """The wall as the physics has it, f32."""

    position: np.ndarray
    """[m], (m, 3)."""
    normal: np.ndarray
    """Out of the lumen, (m, 3)."""
    volume: np.ndarray
    """[m^3], (m,)."""


@dataclass(frozen=True, eq=False)
class RecordedState:
    """The blood at a frame; a particle is a row, all zeros once it has left."""

    position: np.ndarray
    """[m], (n, 3)."""
    velocity: np.ndarray
    """[m/s], (n, 3)."""
    alive: np.ndarray
    """(n,), bool."""


@dataclass(frozen=True)
class Substeps:
    """The steps that the physics took in one frame interval; none in an empty vessel."""

    count: int = 0
    smallest: float = 0.0
    """[s]"""
    largest: float = 0.0
    """[s]"""


def mean_acceleration(
    before: np.ndarray, after: np.ndarray, alive: np.ndarray, interval: float
) -> np.ndarray:
    """(v(t + T) - v(t))/T [m/s^2], f32, shape of `before`; 0 where not `alive` at t + T."""
    change = (after.astype(np.float64) - before) / interval
    return np.where(alive[..., None], change, 0.0).astype(np.float32)


def layout(
    metadata: RunMetadata, proxies: int, feature_count: int
) -> dict[str, tuple[tuple[int, ...], type, str]]:
    """Shape, type and unit of every dataset of a run; targets are kept beside features."""
    f, n = metadata.frames, metadata.particles
    table: dict[str, tuple[tuple[int, ...], type, str]] = {
        "position": ((f + 1, n, 3), np.float32, "m"),
        "velocity": ((f + 1, n, 3), np.float32, "m/s"),
        "alive": ((f + 1, n), np.uint8, "1"),
        "acceleration": ((f, n, 3), np.float32, "m/s^2"),
        "substep_count": ((f,), np.int32, "1"),
        "substep_smallest": ((f,), np.float64, "s"),
        "substep_largest": ((f,), np.float64, "s"),
        "proxy_position": ((proxies, 3), np.float32, "m"),
        "proxy_normal": ((proxies, 3), np.float32, "1"),
        "proxy_volume": ((proxies,), np.float32, "m^3"),
    }
    if feature_count:
        table["features"] = ((f, n, feature_count), np.float32, "1")
        table["target"] = ((f, n, 3), np.float32, "m/s^2")
    return table


def size_of(metadata: RunMetadata, feature_count: int) -> int:
    """Bytes of a run before compression, proxies left out."""
    table = layout(metadata, 0, feature_count)
    return sum(math.prod(shape) * np.dtype(kind).itemsize for shape, kind, _ in table.values())


def write_metadata(attributes: Any, metadata: RunMetadata) -> None:
    """Write a run's attributes, and their units beside them."""
    for name, value in asdict(metadata).items():
        attributes[name] = value
        if name in UNITS:
            attributes[f"{name}_unit"] = UNITS[name]


def read_metadata(attributes: Any, where: str) -> RunMetadata:
    """A run's attributes, as `write_metadata` wrote them.

    Raises:
        InputError: one is missing.
    """
    values = {}
    for field in fields(RunMetadata):
        if field.name in attributes:
            value = attributes[field.name]
            values[field.name] = value.item() if isinstance(value, np.generic) else value
        elif field.default is MISSING:
            raise InputError(f"{where}: the attribute {field.name} is missing")
    return RunMetadata(**values)


WHEREABOUTS = ("scene_folder", "scene_name")
"""Attributes that say where a run was recorded, and not what it is: a folder may be moved."""


def require_same(found: RunMetadata, wanted: RunMetadata, where: str, advice: str) -> None:
    """Refuse a file about another run than the one asked for.

    Raises:
        InputError: they differ.
    """
    for name, value in asdict(wanted).items():
        have = getattr(found, name)
        if have != value and name not in WHEREABOUTS:
            if isinstance(value, str) and max(len(value), len(have)) > 40:
                what = f"another {name}"
            else:
                what = f"{name} {have}, asked for is {value}"
            raise InputError(f"{where}: holds a run of {what}; {advice}")
