"""Recorded runs, written: a file for each run under way, and the dataset made of them.

A run under way is a line of JSON, the wall and the files of its scene, then a record for each state
with a checksum.  Records are only ever added: a kill or a full disk leaves those that were whole.
"""

import errno
import json
import math
import os
import shutil
import time
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

import h5py
import numpy as np

from nn.dataset.schema import (
    DATASET,
    RUN_UNDER_WAY,
    SCHEMA,
    UNDER_WAY,
    UNITS,
    Proxies,
    RecordedState,
    RunMetadata,
    Substeps,
    layout,
    read_metadata,
    require_same,
    size_of,
    write_metadata,
)
from taichi_sph.errors import InputError
from taichi_sph.system import lock, replaced

COMPRESSION = {"compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True}
SYNC_EVERY = 1.0
"""Wall time after which states are forced onto the disk [s]: it takes as long as a small frame."""


def require_room(path: Path, size: int) -> None:
    """Refuse to begin a file of so many bytes that the disk cannot hold.

    Raises:
        OSError: it cannot.
    """
    if shutil.disk_usage(path.parent).free < size:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def record_type(particles: int, feature_count: int) -> np.dtype:
    """Record of a state: the blood at t_f, its a_i, and the sub-steps that led there."""
    columns: list[tuple[str, str, tuple[int, ...]]] = [
        ("position", "<f4", (particles, 3)),
        ("velocity", "<f4", (particles, 3)),
        ("alive", "u1", (particles,)),
        ("acceleration", "<f4", (particles, 3)),
    ]
    if feature_count:
        columns.append(("features", "<f4", (particles, feature_count)))
    columns += [("count", "<i4", ()), ("smallest", "<f8", ()), ("largest", "<f8", ())]
    return np.dtype([*columns, ("checksum", "<u4", ())])


def _checksum(record: np.ndarray) -> int:
    """CRC-32 of all of a record but its checksum."""
    return zlib.crc32(record.tobytes()[: -record.dtype["checksum"].itemsize])


@dataclass(frozen=True)
class Head:
    """What the file of a run under way begins with."""

    metadata: RunMetadata
    proxies: Proxies
    files: dict[str, bytes]
    """Contents of the files that the scene names, by name."""
    feature_count: int

    @property
    def record(self) -> np.dtype:
        """Record of a state."""
        return record_type(self.metadata.particles, self.feature_count)

    def write(self, file: BinaryIO) -> None:
        """Write it at the start of a file."""
        line = {
            "format": RUN_UNDER_WAY,
            "schema": SCHEMA,
            "metadata": asdict(self.metadata),
            "feature_count": self.feature_count,
            "proxies": len(self.proxies.volume),
            "files": {name: len(content) for name, content in self.files.items()},
        }
        file.write(json.dumps(line).encode() + b"\n")
        for values in asdict(self.proxies).values():
            file.write(np.ascontiguousarray(values, "<f4").tobytes())
        for content in self.files.values():
            file.write(content)

    @classmethod
    def read(cls, file: BinaryIO, path: Path) -> "Head":
        """Read it; the file then stands at the first record.

        Raises:
            InputError: it is something else.
        """
        file.seek(0)
        advice = "delete it to record the run anew"
        if file.read(len(UNDER_WAY)) != UNDER_WAY:
            raise InputError(f"{path}: no run under way of this program; {advice}")
        file.seek(0)
        try:
            line = json.loads(file.readline())
            if line["schema"] != SCHEMA:
                raise InputError(
                    f"{path}: a run under way of schema {line['schema']}, this program writes "
                    f"{SCHEMA}; {advice}"
                )
            m = line["proxies"]
            arrays = [
                np.frombuffer(file.read(4 * math.prod(shape)), "<f4").reshape(shape)
                for shape in ((m, 3), (m, 3), (m,))
            ]
            files = {name: file.read(size) for name, size in line["files"].items()}
            metadata = read_metadata(line["metadata"], str(path))
            return cls(metadata, Proxies(*arrays), files, line["feature_count"])
        except InputError:
            raise
        except (ValueError, KeyError, TypeError):
            raise InputError(f"{path}: a run under way that is damaged; {advice}") from None


def _whole_records(file: BinaryIO, head: Head) -> Iterator[np.ndarray]:
    """Records of a file that stands at the first, up to one that is not whole."""
    kind = head.record
    while len(data := file.read(kind.itemsize)) == kind.itemsize:
        record = np.frombuffer(data, kind)[0]
        if record["checksum"] != _checksum(record):
            return
        yield record


def committed_states(path: Path, metadata: RunMetadata) -> int:
    """States of a run that are whole in the file of a `RunWriter`; 0 if there is no file yet.

    Raises:
        InputError: the file holds something else, or another run.
    """
    if not path.exists():
        return 0
    with path.open("rb") as file:
        head = Head.read(file, path)
        _require_run(head, metadata, path)
        return sum(1 for _ in _whole_records(file, head))


def _require_run(head: Head, metadata: RunMetadata, path: Path) -> None:
    advice = "delete it, or record the same run to go on"
    require_same(head.metadata, metadata, str(path), advice)


class RunWriter:
    """One run under way, in a file of its own that may be killed at any moment."""

    def __init__(
        self,
        path: Path,
        metadata: RunMetadata,
        proxies: Proxies,
        files: dict[str, bytes],
        feature_count: int = 0,
    ):
        """Begin a run, or go on with the one in the file.

        Args:
            path: the file.
            metadata: what the run is about.
            proxies: the wall.
            files: contents of the files that the scene names, by name.
            feature_count: features of a particle that are kept.

        Raises:
            InputError: the file holds something else, or another run.
            OSError: the disk is full.
        """
        self.path = path
        self.metadata = metadata
        if not path.exists():
            require_room(path, size_of(metadata, feature_count))
            with replaced(path, path.with_name(path.name + ".new")) as new:
                Head(metadata, proxies, files, feature_count).write(new)
        self._file = path.open("r+b", buffering=0)
        try:
            if not lock(self._file):
                raise InputError(f"{path}: another process is writing it")
            with path.open("rb") as file:
                head = self._head = Head.read(file, path)
                _require_run(head, metadata, path)
                for name, value in asdict(proxies).items():
                    if not np.array_equal(getattr(head.proxies, name), value):
                        raise InputError(f"{path}: holds a run with another wall; delete it")
                self._first = file.tell()
                self.states = self._steps = 0
                for record in _whole_records(file, head):
                    self.states += 1
                    self._steps += int(record["count"])
            self._cut()
        except BaseException:
            self._file.close()
            raise
        self._synced = time.monotonic()

    def _cut(self) -> None:
        """Drop what is left of a record that is not whole."""
        end = self._first + self.states * self._head.record.itemsize
        self._file.truncate(end)
        self._file.seek(end)

    def state(self, frame: int) -> RecordedState:
        """A state that has been written."""
        kind = self._head.record
        with self.path.open("rb") as file:
            file.seek(self._first + frame * kind.itemsize)
            record = np.frombuffer(file.read(kind.itemsize), kind)[0]
        return RecordedState(record["position"], record["velocity"], record["alive"].astype(bool))

    def steps(self) -> int:
        """Sub-steps up to the last state."""
        return self._steps

    def append(
        self,
        state: RecordedState,
        acceleration: np.ndarray,
        features: np.ndarray | None,
        substeps: Substeps,
    ) -> None:
        """Add the next state; it is on the disk within `SYNC_EVERY`, the last one at once.

        Args:
            state: the blood at t_f, f the number of states so far.
            acceleration: a_i^n of this frame [m/s^2], (n, 3).
            features: of this frame, (n, feature_count); None for the last state, or if not kept.
            substeps: what led here from the state before; ignored for the first.

        Raises:
            OSError: the disk is full; the states before are whole.
        """
        record = np.zeros((), self._head.record)
        record["position"], record["velocity"] = state.position, state.velocity
        record["alive"], record["acceleration"] = state.alive, acceleration
        if self._head.feature_count and features is not None:
            record["features"] = features
        if self.states:
            for name, value in asdict(substeps).items():
                record[name] = value
        record["checksum"] = _checksum(record)
        rest = memoryview(record.tobytes())
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
            last = self.states == self.metadata.frames
            if last or time.monotonic() - self._synced >= SYNC_EVERY:
                os.fsync(self._file.fileno())
                self._synced = time.monotonic()
        except OSError as error:
            self._cut()
            raise OSError(error.errno, error.strerror, str(self.path)) from None
        self.states += 1
        self._steps += int(record["count"])

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()

    def __enter__(self) -> "RunWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, _: BaseException | None, __: TracebackType | None
    ) -> None:
        self.close()


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Give h5py's errors their file and reason, which it buries in its text."""
    try:
        yield
    except OSError as error:
        full = error.errno == errno.ENOSPC or "No space left" in str(error)
        number = errno.ENOSPC if full else error.errno or errno.EIO
        raise OSError(number, os.strerror(number), str(path)) from None


def merge(parts: Sequence[Path], out: Path) -> None:
    """Make one compressed file of finished runs, which are then deleted.

    Frame by frame, into <out>.part, which becomes `out` when it is whole.

    Args:
        parts: files of `RunWriter`, in the order of their numbers.
        out: the dataset.

    Raises:
        InputError: a part is no finished run.
        OSError: the disk is full.
    """
    files: dict[str, bytes] = {}
    for part in parts:
        with part.open("rb") as source:
            head = Head.read(source, part)
            files |= head.files
            if sum(1 for _ in _whole_records(source, head)) != head.metadata.frames + 1:
                raise InputError(f"{part}: the run is not finished")
    growing = out.with_name(out.name + ".part")
    with _writing(growing):
        require_room(growing, sum(part.stat().st_size for part in parts))
        with replaced(out, growing), h5py.File(growing, "w") as file:
            file.attrs.update(format=DATASET, schema=SCHEMA)
            _store_files(file, files)
            for number, part in enumerate(parts):
                with part.open("rb") as source:
                    _copy_run(source, Head.read(source, part), file.create_group(f"runs/{number}"))
            file.attrs["complete"] = True
    for part in parts:
        part.unlink()


def _store_files(file: h5py.File, files: dict[str, bytes]) -> None:
    """Store what the scene names, byte by byte."""
    group = file.create_group("files")
    for number, (name, content) in enumerate(files.items()):
        values = np.frombuffer(content, np.uint8)
        packed = COMPRESSION if len(values) else {}
        data = group.create_dataset(str(number), data=values, **packed)
        data.attrs.update(name=name, unit="1")


def _copy_run(source: BinaryIO, head: Head, group: h5py.Group) -> None:
    """Copy a run, compressing; the source stands at its first record."""
    metadata, table = head.metadata, {}
    write_metadata(group.attrs, metadata)
    kinds = layout(metadata, len(head.proxies.volume), head.feature_count)
    for name, (shape, kind, unit) in kinds.items():
        by_frame = len(shape) > 1 and not name.startswith("proxy_")
        chunk = (1, *shape[1:]) if by_frame else shape
        packed = {**COMPRESSION, "chunks": chunk} if math.prod(shape) else {}
        table[name] = group.create_dataset(name, shape, kind, **packed)
        table[name].attrs["unit"] = unit
    for name, values in asdict(head.proxies).items():
        if len(values):
            table[f"proxy_{name}"][...] = values
    taken: dict[str, list] = {"count": [], "smallest": [], "largest": []}
    for frame, record in enumerate(_whole_records(source, head)):
        for name in ("position", "velocity", "alive"):
            table[name][frame] = record[name]
        if frame < metadata.frames:
            for name in ("acceleration", "features"):
                if name in table:
                    table[name][frame] = record[name]
        if frame:
            if "target" in table:
                table["target"][frame - 1] = record["acceleration"]
            for name, values in taken.items():
                values.append(record[name])
    for name, values in taken.items():
        table[f"substep_{name}"][...] = values
    counts = np.array(taken["count"])
    some = counts > 0
    statistics = {
        "substep_smallest": np.array(taken["smallest"])[some].min() if some.any() else 0.0,
        "substep_largest": np.array(taken["largest"])[some].max() if some.any() else 0.0,
        "substeps_taken": counts.sum(dtype=np.int64),
        "substeps_most": counts.max(initial=0),
    }
    for name, value in statistics.items():
        group.attrs[name] = value
        if name in UNITS:
            group.attrs[f"{name}_unit"] = UNITS[name]
