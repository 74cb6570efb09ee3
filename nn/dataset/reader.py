"""Recorded runs, read: checked when opened, rows when asked for."""

import re
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import h5py
import msgspec
import numpy as np

from nn.dataset.schema import (
    DATASET,
    READABLE,
    SIGNATURE,
    UNDER_WAY,
    Proxies,
    RecordedState,
    RunMetadata,
    Substeps,
    layout,
    mean_acceleration,
    read_metadata,
)
from taichi_sph.errors import InputError
from taichi_sph.scene import Scene, parse_scene
from taichi_sph.scene_files import named_files, sha256, with_files


def open_dataset(path: Path) -> h5py.File:
    """Open a finished dataset.

    Raises:
        InputError: there is none, it is cut, or it is something else.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    with path.open("rb") as file:
        begins = file.read(len(UNDER_WAY))
    if begins.startswith(UNDER_WAY):
        raise InputError(f"{path}: a run that is not finished; `vesselflow record` goes on with it")
    if not begins.startswith(SIGNATURE):
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
        if opened.attrs.get("format") != DATASET:
            raise InputError(
                f"{path}: an HDF5 file of another program; `vesselflow record` writes datasets"
            )
        schema = opened.attrs.get("schema")
        if schema not in READABLE:
            known = " and ".join(map(str, READABLE))
            raise InputError(f"{path}: schema {schema}, but this program reads {known}")
        if not opened.attrs.get("complete"):
            raise InputError(f"{path}: the dataset is not finished; record it again")
    except BaseException:
        opened.close()
        raise
    return opened


class SceneFiles:
    """The files that the scene of a dataset names: those in it, or of schema 1 beside it."""

    def __init__(self, path: Path, contents: dict[str, bytes] | None):
        """Files of a dataset at `path`; None of schema 1, which holds none."""
        self._path = path
        self._contents = contents
        self._folder: tempfile.TemporaryDirectory | None = None
        self._placed = 0

    def places(self, facts: RunMetadata) -> list[Path]:
        """Folders where a scene may lie now: moved with the dataset, or where it was recorded."""
        name = re.split(r"[/\\]", facts.scene_folder.rstrip("/\\"))[-1]
        here = self._path.parent
        beside = [here / name]
        if self._contents is None or here.resolve().name == name:
            beside.append(here)
        return list(dict.fromkeys([*beside, Path(facts.scene_folder)]))

    def placed(self, scene: Scene, facts: RunMetadata) -> Scene:
        """The scene, naming files that hold what was recorded.

        Raises:
            InputError: a file that it names is missing, or differs from what was recorded.
        """
        contents = {}
        for kind, name in named_files(scene):
            wanted = facts.surface_sha256 if kind == "surface" else facts.tool_sha256
            if self._contents is not None and name in self._contents:
                wanted = sha256(self._contents[name])
            beside = [place / name for place in self.places(facts)]
            there = next((path for path in beside if path.is_file()), None)
            content = there.read_bytes() if there is not None else None
            if content is not None and wanted and sha256(content) != wanted:
                raise InputError(
                    f"{self._path}: its {kind} differs: {there} is not what was recorded; put that "
                    "back, move this dataset away from there, or record again"
                )
            if self._contents is not None:
                content = self._contents.get(name)
            if content is None:
                raise InputError(
                    f"{self._path}: the file {name} of its scene is not in it, as it is of schema "
                    f"1; put {name} into {self.places(facts)[0]}, or beside the dataset"
                )
            contents[name] = content
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="vesselflow-")
        self._placed += 1
        folder = Path(self._folder.name) / str(self._placed)
        folder.mkdir()
        return with_files(scene, contents, folder)

    def close(self) -> None:
        """Remove the files that were written for scenes."""
        if self._folder is not None:
            self._folder.cleanup()


class Run:
    """One recorded run; rows are read when asked for, one frame or a slice of frames."""

    def __init__(self, group: h5py.Group, path: Path, files: "SceneFiles"):
        """Check that all is there.

        Args:
            group: the run.
            path: its file.
            files: what its scene names.

        Raises:
            InputError: a dataset or attribute is missing or has the wrong shape or unit.
        """
        self.name: str = group.name.rsplit("/", 1)[-1]
        self._group = group
        self._files = files
        self._where = f"{path}: runs/{self.name}"
        self.facts = read_metadata(group.attrs, self._where)
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
        """The scene as it ran, with this run's column; its files last while the dataset is open.

        Raises:
            InputError: the text is of another version of the program; a file that it names is
                missing, or differs from what was recorded.
        """
        facts = self.facts
        scene = parse_scene(facts.scene, self._where, Path(facts.scene_folder), facts.scene_name)
        column = msgspec.structs.replace(
            scene.column, height=facts.height, particles=None, full=False
        )
        return self._files.placed(msgspec.structs.replace(scene, column=column), facts)

    @property
    def has_features(self) -> bool:
        """Whether features are stored."""
        return "features" in self._group

    def _read(self, name: str, rows: int | slice) -> np.ndarray:
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

    def position(self, frame: int | slice) -> np.ndarray:
        """[m], (n, 3) or (frames, n, 3); frame 0 to `len(run)`, the end of the last interval."""
        return self._read("position", frame)

    def velocity(self, frame: int | slice) -> np.ndarray:
        """[m/s], as `position`."""
        return self._read("velocity", frame)

    def alive(self, frame: int | slice) -> np.ndarray:
        """Whether a particle is in the vessel, bool, (n,) or (frames, n)."""
        return self._read("alive", frame).astype(bool)

    def state(self, frame: int) -> RecordedState:
        """The blood at a frame."""
        return RecordedState(self.position(frame), self.velocity(frame), self.alive(frame))

    def acceleration(self, frame: int | slice) -> np.ndarray:
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

    def features(self, frame: int | slice) -> np.ndarray:
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
        self._file = open_dataset(path)
        try:
            groups = self._file.get("runs", {})
            if not len(groups):
                raise InputError(f"{path}: the dataset has no runs")
            self._scene_files = SceneFiles(path, _read_files(self._file, path))
            self.runs = tuple(
                Run(groups[name], path, self._scene_files) for name in sorted(groups, key=int)
            )
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
        """Let go of the file, and of what was written for its scenes."""
        self._scene_files.close()
        self._file.close()

    def __enter__(self) -> "Dataset":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, _: BaseException | None, __: TracebackType | None
    ) -> None:
        self.close()


def _read_files(file: h5py.File, path: Path) -> dict[str, bytes] | None:
    """Contents of the scene's files by name; None of schema 1.

    Raises:
        InputError: one is damaged.
    """
    if file.attrs["schema"] == 1:
        return None
    try:
        return {data.attrs["name"]: data[...].tobytes() for data in file["files"].values()}
    except (OSError, KeyError):
        raise InputError(f"{path}: the files of its scene are damaged; copy it again") from None


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
