"""The two streams of a view: a recording's file, and a live view that never slows the run."""

import errno
import os
import queue
import socket
import threading
import time
from pathlib import Path
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from taichi_sph.errors import InputError
from taichi_sph.system import has_bytes, named_pipe

LIVE_MEMORY = "64MiB"
"""What the server keeps of the past for viewers that come late; it takes twice that."""
_BATCH = 64 << 20
"""Bytes of a batch: with the default small rows starve beside large ones."""
FILE_TICK = 2.0
"""A write follows the last by this or twice this [s]; Rerun remembers 10 kB of each for the end."""
_LIVE_TICK = 0.02
"""Time between two messages to viewers [s]."""
DISK_TIMEOUT = 60.0
"""Longest wait for the disk, at a checkpoint and at the end [s]."""
_LIVE_TIMEOUT = 2.0
"""Longest wait for a viewer at the end [s]."""
_LIVE_QUEUE = 4
"""Frames that wait for a viewer before frames are dropped."""

Items = list[tuple[str, Any]]
"""What is logged of a frame: entities and what they are."""


class FileWriter:
    """Bytes of a recording on their way to a file.

    Rerun's own file writer dies silently on a full disk, and closing it then hangs.  Given a pipe
    it sees no error: this thread empties the pipe, writes the file and keeps what went wrong.
    """

    def __init__(self, path: Path):
        """Open the file.

        Raises:
            InputError: it cannot be opened.
        """
        self.path = path
        self.error: OSError | None = None
        self._sink: int | None
        try:
            self._file = open(path, "wb", buffering=0)  # noqa: SIM115
        except OSError as error:
            raise InputError(f"--rrd {path}: cannot be written: {error.strerror}") from None
        self._thread = threading.Thread(target=self._pump, daemon=True, name="recording")
        pipe = named_pipe()
        if pipe is None:  # Rerun writes the file itself, and says less of a full disk
            self._file.close()
            self._sink, self.sink_path = None, str(path)
            return
        self._pumping = threading.Lock()
        self._source, sink, self.sink_path = pipe
        self._sink = sink
        self._thread.start()

    def opened(self) -> None:
        """Rerun has opened the pipe: it alone holds the writing end now."""
        if self._sink is not None:
            os.close(self._sink)

    def _pump(self) -> None:
        data = b"all"
        while data:
            has_bytes(self._source, None)
            with self._pumping:
                data = os.read(self._source, 1 << 20)
                rest = memoryview(data)
                try:
                    while rest and not self.error:
                        rest = rest[self._file.write(rest) :]
                except OSError as error:
                    self.error = error
        try:
            # Some file systems tell of a full disk only now; a device cannot be synchronised.
            os.fsync(self._file.fileno())
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):
                self.error = self.error or error
        finally:
            os.close(self._source)
            self._file.close()

    def drain(self) -> None:
        """Wait until the pipe is empty and what was in it is in the file, or cannot be.

        Raises:
            OSError: the disk does not answer.
        """
        end = time.monotonic() + DISK_TIMEOUT
        while self._thread.is_alive() and not self.error:
            if self._pumping.acquire(timeout=DISK_TIMEOUT):
                waiting = has_bytes(self._source, 0)
                self._pumping.release()
                if not waiting:
                    return
            if time.monotonic() > end:
                raise self.timeout_error
            time.sleep(1e-3)

    @property
    def timeout_error(self) -> OSError:
        """What is said of a disk that does not answer."""
        return OSError(f"{self.path}: the disk has not answered for {DISK_TIMEOUT:g} s")

    def check(self) -> None:
        """Raise what went wrong, if anything.

        Raises:
            OSError: the disk is full, or fails.
        """
        if self.error:
            raise OSError(
                f"{self.path}: the recording cannot be written: {self.error.strerror}; "
                "what is in it so far can be rescued with `rerun rrd optimize --continue-on-error`"
            )

    def close(self) -> None:
        """Wait for the last byte, after rerun has closed the pipe.

        Raises:
            OSError: as `check`, or the disk does not answer.
        """
        if self._sink is not None:
            self._thread.join(DISK_TIMEOUT)
            if self._thread.is_alive():
                raise self.timeout_error
        elif not self.path.stat().st_size:
            raise OSError(f"{self.path}: the recording cannot be written")
        self.check()


def open_stream(application: str, identity: str, tick: float) -> rr.RecordingStream:
    """A stream of a recording; viewers keep camera and layout by the name of the application."""
    stream = rr.RecordingStream(
        application,
        recording_id=identity,
        batcher_config=rr.ChunkBatcherConfig(flush_num_bytes=_BATCH, flush_tick=tick),
    )
    stream.set_log_time_enabled(False)
    return stream


def send(stream: rr.RecordingStream, frame: int, time: float, items: Items) -> None:
    """Log a frame at its time [s]."""
    stream.set_time("sim_time", duration=time)
    stream.set_time("frame", sequence=frame)
    for entity, archetype in items:
        stream.log(entity, archetype)


class LiveView:
    """A server on loopback that viewers connect to, come and go.

    For a viewer that has frozen Rerun holds about 0.5 GB, then this drops frames.
    """

    def __init__(self, port: int, application: str, identity: str, blueprint: rrb.Blueprint):
        """Serve at a port.

        Raises:
            InputError: the port is taken.
        """
        with socket.socket() as probe:
            if os.name == "posix":  # Windows would take a port that is in use
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("127.0.0.1", port))
            except OSError as error:
                raise InputError(f"--live {port}: no port to serve at: {error.strerror}") from None
        self.url = f"rerun+http://127.0.0.1:{port}/proxy"
        self.dropped = 0
        self._delivered = False
        self.stream = open_stream(application, identity, _LIVE_TICK)
        self.stream.set_sinks(
            rr.GrpcServerSink(bind_ip="127.0.0.1", port=port, server_memory_limit=LIVE_MEMORY),
            default_blueprint=blueprint,
        )
        self._queue: queue.Queue[tuple[int, float, Items] | None] = queue.Queue(_LIVE_QUEUE)
        self._thread = threading.Thread(target=self._pump, daemon=True, name="live view")
        self._thread.start()

    def _pump(self) -> None:
        while item := self._queue.get():
            send(self.stream, *item)
        try:
            self.stream.flush(timeout_sec=_LIVE_TIMEOUT)
        except RuntimeError:
            return
        self._delivered = True
        self.stream.disconnect()

    def offer(self, frame: int, time: float, items: Items) -> None:
        """Show a frame, if the viewer keeps up."""
        try:
            self._queue.put_nowait((frame, time, items))
        except queue.Full:
            self.dropped += 1

    def close(self) -> bool:
        """End the server; False if a viewer has stalled and holds it up."""
        try:
            self._queue.put(None, timeout=_LIVE_TIMEOUT)
        except queue.Full:
            return False
        self._thread.join(2.0 * _LIVE_TIMEOUT)
        return self._delivered
