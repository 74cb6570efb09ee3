"""Jobs on a Dask cluster.

What a job needs goes with it: the content of every file that a path or a scene in it names.  So
workers need the program, and none of the folders.
"""

import io
import logging
import pickle
import tempfile
import time
import warnings
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

from app import version
from app.jobs.process import ATTEMPTS, POLL, Event, Process, ProcessError
from taichi_sph.errors import InputError, RunError
from taichi_sph.scene import Scene
from taichi_sph.scene_files import read_files, sha256, with_files
from taichi_sph.system import processors

CONNECTING = 20.0
"""Wall time in which a scheduler must answer [s]."""
LOST_AFTER = 10.0
"""Wall time without a scheduler after which it is lost [s]."""
NO_WORKERS = 300.0
"""Wall time without any worker after which nobody will come [s]: batch systems take minutes."""


class Packer(pickle.Pickler):
    """Pickler of a job to be done elsewhere; keeps the contents of its files by their hash."""

    def __init__(self, file: io.BytesIO, contents: dict[str, bytes]):
        """Write to `file`, and add to `contents`."""
        super().__init__(file)
        self._contents = contents

    def _keep(self, content: bytes) -> str:
        key = sha256(content)
        self._contents[key] = content
        return key

    def persistent_id(self, value: Any) -> Any:
        """What stands for a scene or for the path of a file; None for all else."""
        if isinstance(value, Scene):
            files = {name: self._keep(content) for name, content in read_files(value).items()}
            return "scene", pickle.dumps(value), files
        if isinstance(value, Path) and value.is_file():
            return "file", value.name, self._keep(value.read_bytes())
        return None


class Unpacker(pickle.Unpickler):
    """Reader of what a `Packer` wrote: files are written where they are wanted."""

    def __init__(self, file: io.BytesIO, contents: dict[str, bytes], folder: Path):
        """Write the files below a folder."""
        super().__init__(file)
        self._contents, self._folder = contents, folder

    def persistent_load(self, pid: Any) -> Any:
        """The scene or path again, of files that are here."""
        kind, what, keys = pid
        folder = Path(tempfile.mkdtemp(dir=self._folder))
        if kind == "scene":
            files = {name: self._contents[key] for name, key in keys.items()}
            return with_files(pickle.loads(what), files, folder)
        (folder / what).write_bytes(self._contents[keys])
        return folder / what


def pack(work: Callable[..., Any], job: Any, contents: dict[str, bytes]) -> bytes:
    """A function and its job, to be done elsewhere; adds the contents of its files by hash."""
    file = io.BytesIO()
    Packer(file, contents).dump((work, job))
    return file.getvalue()


def call_packed(packed: bytes, contents: dict[str, bytes]) -> Any:
    """Do what `pack` wrote."""
    with tempfile.TemporaryDirectory(prefix="vesselflow-") as folder:
        work, job = Unpacker(io.BytesIO(packed), contents, Path(folder)).load()
        return work(job)


# On a worker.


def same(content: bytes) -> bytes:
    """The content of a file, which the scheduler can make again where a worker has lost it."""
    return content


def _is_cancelled() -> bool:
    """Whether nobody waits for the task of this thread any more."""
    from distributed import get_worker

    worker = get_worker()
    task = worker.state.tasks.get(worker.get_current_task())
    return task is None or task.state in ("cancelled", "released")


def run_on_worker(
    packed: bytes, label: str, of_version: str, keys: Sequence[str], *contents: bytes
) -> tuple[Any, Exception | None]:
    """Result and error of a packed job, in a process of its own beside the worker's.

    Workers have threads and may be daemons: neither Taichi nor multiprocessing likes that.
    """
    from distributed import get_worker

    if version() != of_version:
        return None, InputError(
            f"--scheduler: a worker has vesselflow {version()}, asked for is {of_version}; "
            "install the same on both"
        )
    threads = max(1, len(processors()) // get_worker().state.nthreads)
    call = pickle.dumps((call_packed, (packed, dict(zip(keys, contents, strict=True)))))
    for _ in range(ATTEMPTS):
        process = Process(call, threads)
        try:
            while not process.has_ended:
                time.sleep(POLL)
                if _is_cancelled():
                    return None, ProcessError(f"{label}: nobody waits for it")
            return process.answer()
        except ProcessError as killed:
            death = killed
        finally:
            process.stop()
    return None, ProcessError(f"{label}: {death}, {ATTEMPTS} times, on {get_worker().address}")


# At who asks.


def address_of(scheduler: str) -> str:
    """The address in "dask:ADDRESS".

    Raises:
        InputError: it is something else, or Dask is not installed.
    """
    kind, _, address = scheduler.partition(":")
    if kind != "dask" or not address:
        raise InputError(f"--scheduler {scheduler}: allowed is dask:ADDRESS")
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise InputError(
            f"--scheduler {scheduler}: needs Dask; install it with: "
            "pip install 'vesselflow[cluster]'"
        ) from None
    return address


def connect(scheduler: str) -> Any:
    """A client of a scheduler.

    Raises:
        InputError: nobody answers there, or not as a scheduler does.
    """
    address = address_of(scheduler)
    from distributed import Client

    # What goes wrong is said by us, in a sentence.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    try:
        return Client(address, timeout=CONNECTING, set_as_default=False)
    except Exception as error:  # of sockets, of names, of protocols
        raise InputError(
            f"--scheduler {scheduler}: no scheduler answers there ({type(error).__name__})"
        ) from None


def run_on_cluster(
    work: Callable[[Any], Any], jobs: Sequence[Any], scheduler: str
) -> Generator[Event, None, None]:
    """Run jobs on the workers of a Dask cluster; yields what happens.

    Dask gives the job of a worker that has died to another, a few times.

    Raises:
        InputError: the scheduler cannot be used.
        RunError: the scheduler or all workers are lost.
    """
    client = connect(scheduler)
    waiting: dict[int, Any] = {}
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Sending large graph")
            waiting = _submit(client, work, jobs)
        ended, seen, warned = 0, time.monotonic(), False
        while waiting:
            time.sleep(POLL)
            yield Event(ended)
            for number in [k for k, future in waiting.items() if future.status != "pending"]:
                future = waiting.pop(number)
                if future.status in ("lost", "cancelled"):
                    raise _lost(scheduler)
                result, error = _outcome(future, f"{jobs[number]}", scheduler)
                ended += 1
                yield Event(ended, number, result, error)
            now = time.monotonic()
            if client.status != "running":
                if now - seen > LOST_AFTER or client.status == "closed":
                    raise _lost(scheduler)
            elif client.scheduler_info()["workers"]:
                seen, warned = now, False
            elif now - seen > NO_WORKERS:
                raise RunError(f"--scheduler {scheduler}: has had no worker for {NO_WORKERS:g} s")
            elif now - seen > LOST_AFTER and not warned:
                warned = True
                yield Event(ended, sentence=f"--scheduler {scheduler}: waiting for workers")
    finally:
        _leave(client, list(waiting.values()))


def _submit(client: Any, work: Callable[[Any], Any], jobs: Sequence[Any]) -> dict[int, Any]:
    """Futures of jobs by number; each content is sent once."""
    contents: dict[str, bytes] = {}
    sent: dict[str, Any] = {}
    futures = {}
    for number, job in enumerate(jobs):
        needed: dict[str, bytes] = {}
        packed = pack(work, job, needed)
        contents |= needed
        for key, content in needed.items():
            if key not in sent:
                sent[key] = client.submit(same, content, key=f"vesselflow-file-{key}")
        futures[number] = client.submit(
            run_on_worker, packed, str(job), version(), list(needed),
            *(sent[key] for key in needed), pure=False,
        )  # fmt: skip
    return futures


def _outcome(future: Any, label: str, scheduler: str) -> tuple[Any, Exception | None]:
    """Result and error of a job that Dask has ended."""
    from distributed import KilledWorker

    error = future.exception()
    if error is None:
        return future.result()
    if isinstance(error, KilledWorker):
        return None, ProcessError(
            f"{label}: the workers that it was on have died, one after another"
        )
    if isinstance(error, ImportError):
        return None, InputError(
            f"--scheduler {scheduler}: a worker cannot import vesselflow ({error}); install "
            f"vesselflow {version()} there"
        )
    return None, error


def _lost(scheduler: str) -> RunError:
    return RunError(
        f"--scheduler {scheduler}: the scheduler is lost; the same command goes on where it was"
    )


def _leave(client: Any, unfinished: list[Any]) -> None:
    """Tell the scheduler, if it is there, that nobody waits any more."""
    try:
        if client.status == "running" and unfinished:
            client.cancel(unfinished, force=True)
        client.close(timeout=2)
    except Exception:  # it is gone, and so are we
        pass
