"""Recorded runs: the HDF5 schema, its writer, its reader and its check; no other file knows it.

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

Numbers are stored as the simulation has them, in single precision; one chunk is one frame,
compressed, with a Fletcher-32 checksum.  `RunMetadata` lists the attributes of a run.  Split by
run, never by sample: neighbouring frames are nearly the same.
"""

import errno
import fcntl
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import TracebackType

import h5py
import msgspec
import numpy as np

from taichi_sph.errors import InputError
from taichi_sph.scene import Scene, parse_scene

SIGNATURE = b"\x89HDF\r\n\x1a\n"
"""How every HDF5 file begins."""
DATASET = "vesselflow dataset"
PART = "vesselflow run under way"
SCHEMA = 1
COMPRESSION = {"compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True}
COMMIT_EVERY = 1.0
"""Wall time after which frames are forced onto the disk [s]: it takes as long as a small frame."""
Rows = int | slice


@dataclass(frozen=True)
class RunMetadata:
    """What a run is about: its attributes in the file, the same in every recording of it."""

    scene: str
    """TOML text of the scene; `height` replaces its column's."""
    scene_name: str
    scene_folder: str
    """Where the scene's relative paths started."""
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
    facts: RunMetadata, proxies: int, feature_count: int
) -> dict[str, tuple[tuple[int, ...], type, str]]:
    """Shape, type and unit of every dataset of a run; targets are kept beside features."""
    f, n = facts.frames, facts.particles
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


def size_of(facts: RunMetadata, feature_count: int) -> int:
    """Bytes of a run before compression, proxies left out."""
    table = layout(facts, 0, feature_count)
    return sum(math.prod(shape) * np.dtype(kind).itemsize for shape, kind, _ in table.values())


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Give h5py's errors their file and reason, which it buries in its text."""
    try:
        yield
    except OSError as error:
        text = str(error)
        if "unable to lock file" in text:
            raise InputError(f"{path}: another process is writing it") from None
        full = error.errno == errno.ENOSPC or "No space left" in text
        number = errno.ENOSPC if full else error.errno or errno.EIO
        raise OSError(number, os.strerror(number), str(path)) from None


def _require_room(path: Path, size: int) -> None:
    """Refuse to begin a file that the disk cannot hold."""
    files = os.statvfs(path.parent)
    if files.f_bavail * files.f_frsize < size:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def _write_metadata(group: h5py.Group, facts: RunMetadata) -> None:
    for name, value in asdict(facts).items():
        group.attrs[name] = value
        if name in UNITS:
            group.attrs[f"{name}_unit"] = UNITS[name]


def _read_metadata(group: h5py.Group, where: str) -> RunMetadata:
    values = {}
    for field in fields(RunMetadata):
        if field.name not in group.attrs:
            raise InputError(f"{where}: the attribute {field.name} is missing")
        value = group.attrs[field.name]
        values[field.name] = value.item() if isinstance(value, np.generic) else value
    return RunMetadata(**values)


def require_same(found: RunMetadata, wanted: RunMetadata, where: str, advice: str) -> None:
    """Refuse a file about another run than the one asked for.

    Raises:
        InputError: they differ.
    """
    for name, value in asdict(wanted).items():
        have = getattr(found, name)
        if have != value:
            if isinstance(value, str) and max(len(value), len(have)) > 40:
                what = f"another {name}"
            else:
                what = f"{name} {have}, asked for is {value}"
            raise InputError(f"{where}: holds a run of {what}; {advice}")


def committed_states(path: Path, facts: RunMetadata) -> int:
    """States of a run that are safe in the file of a `RunWriter`; 0 if there is no file yet.

    Raises:
        InputError: the file holds something else, or another run.
    """
    if not path.exists():
        return 0
    with _open(path, PART) as file:
        _require_run(file, facts, path)
        return int(file["committed"][0])


def _require_run(file: h5py.File, facts: RunMetadata, path: Path) -> None:
    advice = "delete it, or record the same run to go on"
    require_same(_read_metadata(file, str(path)), facts, str(path), advice)


@dataclass(frozen=True)
class _Place:
    """Where the rows of a dataset stand in the file of a run under way."""

    offset: int
    """Of row 0 [bytes]."""
    shape: tuple[int, ...]
    """Of a row."""
    kind: np.dtype


class RunWriter:
    """One run under way, in a file of its own that may be killed at any moment.

    HDF5 lays the file out whole at the start, uncompressed; rows are then written straight to
    their places.  So nothing that HDF5 needs to read the file is ever half-written, and a disk
    that fails says so at once: HDF5 would tell of it when it is closed, or crash.  `committed`
    is written last, when the rows are on the disk.
    """

    def __init__(self, path: Path, facts: RunMetadata, proxies: Proxies, feature_count: int = 0):
        """Begin a run, or go on with the one in the file.

        Raises:
            InputError: the file holds something else, or another run.
            OSError: the disk is full.
        """
        self.path = path
        self.facts = facts
        with _writing(path):
            if not path.exists():
                # A layout that is killed half-way must not be taken for a run.
                new = path.with_name(path.name + ".new")
                _require_room(new, size_of(facts, feature_count))
                with h5py.File(new, "w") as file:
                    _lay_out(file, facts, proxies, feature_count)
                os.replace(new, path)
            with _open(path, PART) as file:
                _require_run(file, facts, path)
                for name, value in asdict(proxies).items():
                    if not np.array_equal(file[f"proxy_{name}"][...], value):
                        raise InputError(f"{path}: holds a run with another wall; delete it")
                self._places = {
                    name: _Place(data.id.get_offset(), data.shape[1:], data.dtype)
                    for name, data in file.items()
                }
            self._file = os.open(path, os.O_RDWR)
            try:
                # The lock that HDF5 itself takes and heeds.
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(self._file)
                raise InputError(f"{path}: another process is writing it") from None
        self._states = self.committed
        self._last_commit = time.monotonic()

    def _get(self, name: str, row: int, rows: int = 1) -> np.ndarray:
        """Rows of a dataset, (rows, ...)."""
        place = self._places[name]
        size = math.prod(place.shape) * place.kind.itemsize
        data = os.pread(self._file, rows * size, place.offset + row * size)
        return np.frombuffer(data, place.kind).reshape(rows, *place.shape)

    def _put(self, name: str, row: int, values: object) -> None:
        """Write a row of a dataset."""
        place = self._places[name]
        array = np.asarray(values, place.kind)
        if array.shape != place.shape:
            raise ValueError(f"{name}: a row of shape {array.shape}, expected {place.shape}")
        rest = memoryview(array.tobytes())
        offset = place.offset + row * len(rest)
        while rest:
            done = os.pwrite(self._file, rest, offset)
            rest, offset = rest[done:], offset + done

    @property
    def committed(self) -> int:
        """States that are safely in the file; a run has frames + 1."""
        return int(self._get("committed", 0)[0])

    def state(self, frame: int) -> RecordedState:
        """A state that has been committed."""
        position, velocity, alive = (
            self._get(name, frame)[0] for name in ("position", "velocity", "alive")
        )
        return RecordedState(position, velocity, alive.astype(bool))

    def steps(self) -> int:
        """Sub-steps up to the last state."""
        return int(self._get("substep_count", 0, max(0, self._states - 1)).sum(dtype=np.int64))

    def append(
        self,
        state: RecordedState,
        acceleration: np.ndarray,
        features: np.ndarray | None,
        substeps: Substeps,
    ) -> None:
        """Add the next state; it is committed within `COMMIT_EVERY`, the last one at once.

        Args:
            state: the blood at t_f, f the number of states so far.
            acceleration: a_i^n of this frame [m/s^2], (n, 3).
            features: of this frame, (n, feature_count); None for the last state, or if not kept.
            substeps: what led here from the state before; ignored for the first.

        Raises:
            OSError: the disk is full.
        """
        frame = self._states
        rows: list[tuple[str, int, object]] = [
            ("position", frame, state.position),
            ("velocity", frame, state.velocity),
            ("alive", frame, state.alive),
        ]
        if frame < self.facts.frames:
            rows.append(("acceleration", frame, acceleration))
            if "features" in self._places:
                rows.append(("features", frame, features))
        if frame > 0:
            steps = asdict(substeps)
            rows += [(f"substep_{name}", frame - 1, value) for name, value in steps.items()]
            if "target" in self._places:
                rows.append(("target", frame - 1, acceleration))
        with _writing(self.path):
            for row in rows:
                self._put(*row)
            self._states = frame + 1
            if frame == self.facts.frames or time.monotonic() - self._last_commit >= COMMIT_EVERY:
                self._commit()

    def _commit(self) -> None:
        """Say that the states so far are in the file, once they are on the disk."""
        os.fsync(self._file)
        self._put("committed", 0, self._states)
        self._last_commit = time.monotonic()

    def close(self) -> None:
        """Commit and let go of the file."""
        with _writing(self.path):
            try:
                if self._states > self.committed:
                    self._commit()
            finally:
                os.close(self._file)

    def __enter__(self) -> "RunWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, _: BaseException | None, __: TracebackType | None
    ) -> None:
        self.close()


def _lay_out(file: h5py.File, facts: RunMetadata, proxies: Proxies, feature_count: int) -> None:
    """Everything that a run will fill, at its final place in the file."""
    file.attrs.update(format=PART, schema=SCHEMA)
    _write_metadata(file, facts)
    place = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    place.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    table = layout(facts, len(proxies.volume), feature_count)
    for name, (shape, kind, unit) in table.items():
        # No rows means nothing to place, which HDF5 refuses to do early.
        early = place if math.prod(shape) else None
        file.create_dataset(name, shape, kind, dcpl=early).attrs["unit"] = unit
    for name, value in asdict(proxies).items():
        file[f"proxy_{name}"][...] = value
    file.create_dataset("committed", (1,), np.int64, dcpl=place).attrs["unit"] = "1"


def _open(path: Path, wanted: str) -> h5py.File:
    """Open a file of ours.

    Raises:
        InputError: there is none, it is cut, or it is something else.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    with path.open("rb") as file:
        begins = file.read(len(SIGNATURE))
    if begins != SIGNATURE:
        what = "the file is empty" if not begins else "the file is no HDF5"
        raise InputError(f"{path}: {what}; a dataset is what `vesselflow record` writes")
    try:
        opened = h5py.File(path, "r")
    except OSError as error:
        text = str(error)
        if "unable to lock file" in text:
            raise InputError(f"{path}: another process is writing it") from None
        if "truncated" in text or "eof" in text:
            raise InputError(
                f"{path}: the file is cut at {path.stat().st_size} bytes; copy or record it again"
            ) from None
        raise InputError(f"{path}: the HDF5 file is damaged; copy or record it again") from None
    try:
        kind = opened.attrs.get("format")
        if kind != wanted:
            if kind == PART:
                what = "a run that is not finished; `vesselflow record` goes on with it"
            elif kind == DATASET:
                what = "a finished dataset"
            else:
                what = "an HDF5 file of another program; `vesselflow record` writes datasets"
            raise InputError(f"{path}: {what}")
        schema = opened.attrs.get("schema")
        if schema != SCHEMA:
            raise InputError(f"{path}: schema {schema}, but this program reads schema {SCHEMA}")
        if wanted == DATASET and not opened.attrs.get("complete"):
            raise InputError(f"{path}: the dataset is not finished; record it again")
    except BaseException:
        opened.close()
        raise
    return opened


def merge(
    parts: Sequence[Path], out: Path, show: Callable[[int, int], None] = lambda done, total: None
) -> None:
    """Make one compressed file of finished runs, which are then deleted.

    Frame by frame, into <out>.part, which becomes `out` when it is whole.

    Args:
        parts: files of `RunWriter`, in the order of their numbers.
        out: the dataset.
        show: told after each frame how many of how many are done.

    Raises:
        InputError: a part is no finished run.
        OSError: the disk is full.
    """
    whole = out.with_name(out.name + ".part")
    total, done, size = 0, 0, 0
    for part in parts:
        with _open(part, PART) as source:
            frames = int(source.attrs["frames"])
            if source["committed"][0] != frames + 1:
                raise InputError(f"{part}: the run is not finished")
            total += frames + 1
        size += part.stat().st_size
    with _writing(whole):
        _require_room(whole, size)
        with h5py.File(whole, "w") as file:
            file.attrs.update(format=DATASET, schema=SCHEMA)
            for number, part in enumerate(parts):
                with _open(part, PART) as source:
                    group = file.create_group(f"runs/{number}")
                    for done_here in _copy_run(source, group):
                        show(done + done_here, total)
                    done += int(source.attrs["frames"]) + 1
            file.attrs["complete"] = True
            file.flush()
            os.fsync(file.id.get_vfd_handle())
        os.replace(whole, out)
    for part in parts:
        part.unlink()


def _copy_run(source: h5py.File, group: h5py.Group) -> Iterator[int]:
    """Copy a run, compressing; yields the frames done."""
    for name, value in source.attrs.items():
        if name not in ("format", "schema"):
            group.attrs[name] = value
    counts = source["substep_count"][...]
    taken = counts > 0
    smallest, largest = source["substep_smallest"][taken], source["substep_largest"][taken]
    statistics = {
        "substep_smallest": smallest.min() if taken.any() else 0.0,
        "substep_largest": largest.max() if taken.any() else 0.0,
        "substeps_taken": counts.sum(dtype=np.int64),
        "substeps_most": counts.max(initial=0),
    }
    for name, value in statistics.items():
        group.attrs[name] = value
        if name in UNITS:
            group.attrs[f"{name}_unit"] = UNITS[name]
    framed = []
    for name, data in source.items():
        if name == "committed":
            continue
        by_frame = len(data.shape) > 1 and not name.startswith("proxy_")
        chunk = (1, *data.shape[1:]) if by_frame else data.shape
        packed = {**COMPRESSION, "chunks": chunk} if math.prod(data.shape) else {}
        copy = group.create_dataset(name, data.shape, data.dtype, **packed)
        copy.attrs["unit"] = data.attrs["unit"]
        if by_frame:
            framed.append((data, copy))
        elif math.prod(data.shape):
            copy[...] = data[...]
    for frame in range(int(source.attrs["frames"]) + 1):
        for data, copy in framed:
            if frame < len(data):
                copy[frame] = data[frame]
        yield frame + 1


class Run:
    """One recorded run; rows are read when asked for, one frame or a slice of frames."""

    def __init__(self, group: h5py.Group, path: Path):
        """Check that all is there.

        Raises:
            InputError: a dataset or attribute is missing or has the wrong shape or unit.
        """
        self.name: str = group.name.rsplit("/", 1)[-1]
        self._group = group
        self._where = f"{path}: runs/{self.name}"
        self.facts = _read_metadata(group, self._where)
        proxies = group["proxy_volume"].shape[0] if "proxy_volume" in group else 0
        width = group["features"].shape[-1] if "features" in group else 0
        for name, (shape, kind, unit) in layout(self.facts, proxies, width).items():
            if name not in group:
                raise InputError(f"{self._where}: has no {name}")
            data = group[name]
            found = (data.shape, data.dtype, data.attrs.get("unit"))
            if found != (shape, np.dtype(kind), unit):
                raise InputError(
                    f"{self._where}/{name}: is {found[0]} {found[1]} [{found[2]}], "
                    f"expected {shape} {np.dtype(kind)} [{unit}]"
                )

    def __len__(self) -> int:
        """Number of frames that have a target."""
        return self.facts.frames

    @property
    def scene(self) -> Scene:
        """The scene as it ran, with this run's column.

        Raises:
            InputError: the text is of another version of the program.
        """
        facts = self.facts
        scene = parse_scene(facts.scene, self._where, Path(facts.scene_folder), facts.scene_name)
        column = msgspec.structs.replace(
            scene.column, height=facts.height, particles=None, full=False
        )
        return msgspec.structs.replace(scene, column=column)

    @property
    def has_features(self) -> bool:
        """Whether features are stored."""
        return "features" in self._group

    def _read(self, name: str, rows: Rows) -> np.ndarray:
        """Rows of a dataset.

        Raises:
            InputError: the file is damaged there.
        """
        length = self._group[name].shape[0]
        if isinstance(rows, int) and not 0 <= rows < length:
            raise IndexError(f"{self._where}/{name}: frame {rows} of {length}")
        try:
            return self._group[name][rows]
        except OSError:
            raise InputError(
                f"{self._where}/{name}: damaged in frame {rows}; copy or record it again"
            ) from None

    def position(self, frame: Rows) -> np.ndarray:
        """[m], (n, 3) or (frames, n, 3); frame 0 to `len(run)`, the end of the last interval."""
        return self._read("position", frame)

    def velocity(self, frame: Rows) -> np.ndarray:
        """[m/s], as `position`."""
        return self._read("velocity", frame)

    def alive(self, frame: Rows) -> np.ndarray:
        """Whether a particle is in the vessel, bool, (n,) or (frames, n)."""
        return self._read("alive", frame).astype(bool)

    def state(self, frame: int) -> RecordedState:
        """The blood at a frame."""
        return RecordedState(self.position(frame), self.velocity(frame), self.alive(frame))

    def acceleration(self, frame: Rows) -> np.ndarray:
        """Mean over the interval before [m/s^2]: a_i^n of the frame."""
        return self._read("acceleration", frame)

    def target(self, frame: int) -> np.ndarray:
        """Mean acceleration over the interval after [m/s^2], (n, 3)."""
        if "target" in self._group:
            return self._read("target", frame)
        if frame + 1 < len(self):
            return self.acceleration(frame + 1)
        return mean_acceleration(
            self.velocity(frame),
            self.velocity(frame + 1),
            self.alive(frame + 1),
            self.facts.frame_interval,
        )

    def has_target(self, frame: int) -> np.ndarray:
        """Which particles have a target: those alive at both ends of the interval, bool, (n,)."""
        return self.alive(frame + 1)

    def features(self, frame: Rows) -> np.ndarray:
        """Features as recorded, dimensionless, (n, 23).

        Raises:
            InputError: none are stored.
        """
        if not self.has_features:
            raise InputError(f"{self._where}: has no features; record with --features")
        return self._read("features", frame)

    def substeps(self, frame: int) -> Substeps:
        """What the physics took from this frame to the next."""
        names = ("count", "smallest", "largest")
        count, smallest, largest = (self._read(f"substep_{name}", frame) for name in names)
        return Substeps(int(count), float(smallest), float(largest))

    def proxies(self) -> Proxies:
        """The wall."""
        everything = slice(None)
        return Proxies(
            *(self._read(f"proxy_{name}", everything) for name in ("position", "normal", "volume"))
        )


class Dataset:
    """A finished file of runs."""

    def __init__(self, path: Path):
        """Open a file for reading; use it as a context, or close it.

        Raises:
            InputError: it is missing, cut, foreign or not what the schema says.
        """
        self.path = path
        self._file = _open(path, DATASET)
        try:
            groups = self._file.get("runs", {})
            if not len(groups):
                raise InputError(f"{path}: the dataset has no runs")
            self.runs = tuple(Run(groups[name], path) for name in sorted(groups, key=int))
        except BaseException:
            self._file.close()
            raise

    def split(self, held_out: Sequence[int]) -> tuple[tuple[Run, ...], tuple[Run, ...]]:
        """Runs to train on and runs held out, by number.

        Raises:
            InputError: no such run, or nothing is left to train on.
        """
        for number in held_out:
            if not 0 <= number < len(self.runs):
                raise InputError(
                    f"{self.path}: has no run {number} to hold out; allowed are 0 to "
                    f"{len(self.runs) - 1}"
                )
        train = tuple(run for k, run in enumerate(self.runs) if k not in held_out)
        if not train:
            raise InputError(f"{self.path}: all {len(self.runs)} runs are held out; leave one")
        return train, tuple(self.runs[k] for k in held_out)

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()

    def __enter__(self) -> "Dataset":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, _: BaseException | None, __: TracebackType | None
    ) -> None:
        self.close()


def check(path: Path) -> None:
    """Read a dataset whole and check every number, one frame in memory at a time.

    Raises:
        InputError: it cannot be read, a checksum is wrong, or it breaks the schema's promises.
    """
    with Dataset(path) as data:
        for run in data.runs:
            where = f"{path}: runs/{run.name}"
            run.proxies()
            before: RecordedState | None = None
            for frame in range(len(run) + 1):
                now = run.state(frame)
                _check_state(run, frame, before, now, where)
                before = now


def _check_state(
    run: Run, frame: int, before: RecordedState | None, now: RecordedState, where: str
) -> None:
    """Refuse a frame that is not what the schema promises."""
    at = f"frame {frame}"
    rows = {"position": now.position, "velocity": now.velocity}
    if frame < len(run):
        rows["acceleration"] = run.acceleration(frame)
        if run.has_features:
            rows["features"] = run.features(frame)
    for name, values in rows.items():
        if not np.isfinite(values).all():
            raise InputError(f"{where}/{name}: {at} has a number that is not finite")
        if values[~now.alive].any():
            raise InputError(f"{where}/{name}: {at} moves a particle that has left")
    if before is None:
        expected = np.zeros_like(now.velocity)
    else:
        if (now.alive & ~before.alive).any():
            raise InputError(f"{where}/alive: {at} brings back a particle that had left")
        expected = mean_acceleration(
            before.velocity, now.velocity, now.alive, run.facts.frame_interval
        )
        if not np.array_equal(run.target(frame - 1), expected):
            raise InputError(f"{where}/target: {at} is not the change of velocity over T")
    if frame < len(run) and not np.array_equal(rows["acceleration"], expected):
        raise InputError(f"{where}/acceleration: {at} is not the change of velocity over T")
