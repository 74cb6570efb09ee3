"""Recordings read back, and a client that reads a live view as slowly as a test wants."""

import importlib
import importlib.util
import os
import socket
import struct
import subprocess
import time
from pathlib import Path
from types import TracebackType

import numpy as np
import pyarrow
import rerun_cli

from places import ROOT

# Rerun 0.39, of Python 3.10, has it elsewhere.
_CHUNK = "rerun.chunk" if importlib.util.find_spec("rerun.chunk") else "rerun.experimental"
RrdReader = importlib.import_module(_CHUNK).RrdReader

RERUN = Path(rerun_cli.__file__).with_name("rerun")
"""The program itself; `rerun` on the path is a wrapper that orphans it when killed."""


def _flat(values: pyarrow.Array) -> np.ndarray:
    while hasattr(values, "flatten") and values.type.num_fields:
        values = values.flatten()
    return values.to_numpy(zero_copy_only=False)


def rows(path: Path, entity: str, component: str) -> dict[int, np.ndarray]:
    """Values of a component by frame."""
    found = {}
    for chunk in RrdReader(str(path)).stream().filter(content=entity, components=component):
        if chunk.is_static:
            continue
        batch = chunk.to_record_batch()
        frames = batch.column("frame").cast("int64").to_numpy()
        column = batch.column(component)
        for row, frame in enumerate(frames):
            found[int(frame)] = _flat(column[row].values)
    return found


def static(path: Path, entity: str, component: str) -> np.ndarray:
    """Value of a component that never changes."""
    for chunk in RrdReader(str(path)).stream().filter(content=entity, components=component):
        if chunk.is_static:
            return _flat(chunk.to_record_batch().column(component)[0].values)
    raise AssertionError(f"{entity} has no static {component}")


def positions(path: Path) -> dict[int, np.ndarray]:
    """Positions of the blood by frame, (n, 3)."""
    found = rows(path, "/world/blood", "Points3D:positions")
    return {frame: values.reshape(-1, 3) for frame, values in found.items()}


def figures(path: Path, *names: str) -> dict[int, list[float]]:
    """Figures by frame."""
    found = {}
    for chunk in RrdReader(str(path)).stream().filter(content="/figures"):
        batch = chunk.to_record_batch()
        frames = batch.column("frame").cast("int64").to_numpy()
        for frame, (row,) in zip(frames, batch.column("figures:values").to_pylist(), strict=True):
            found[int(frame)] = [row[name] for name in names]
    return found


def verify(path: Path, footers: bool = True) -> bool:
    """Whether `rerun rrd verify` accepts a file."""
    check = subprocess.run(
        [RERUN, "rrd", "verify", f"--check-footers={str(footers).lower()}", path],
        capture_output=True,
        timeout=60,
    )
    return check.returncode == 0


def free_port() -> int:
    """A port of loopback that nothing listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _frame(kind: int, flags: int, stream: int, body: bytes = b"") -> bytes:
    return (
        struct.pack(">I", len(body))[1:] + bytes([kind, flags]) + struct.pack(">I", stream) + body
    )


def _header(name: bytes, value: bytes) -> bytes:
    return b"\x00" + bytes([len(name)]) + name + bytes([len(value)]) + value


class Viewer:
    """What a viewer is to the server: a gRPC request over HTTP/2 that is answered without end.

    It needs no graphics, and reads no more than it is told to: between, it is a frozen viewer.
    """

    def __init__(self, port: int, patience: float = 30.0):
        deadline = time.monotonic() + patience
        while True:
            try:
                self.socket = socket.create_connection(("127.0.0.1", port), timeout=patience)
                break
            except OSError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.05)
        headers = b"".join(
            _header(name, value)
            for name, value in (
                (b":method", b"POST"),
                (b":scheme", b"http"),
                (b":path", b"/rerun.sdk_comms.v1alpha1.MessageProxyService/ReadMessages"),
                (b":authority", b"127.0.0.1"),
                (b"content-type", b"application/grpc"),
                (b"te", b"trailers"),
            )
        )
        largest = 2**31 - 1
        self.socket.sendall(
            b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
            + _frame(4, 0, 0, struct.pack(">HI", 4, largest))  # settings: an endless window
            + _frame(8, 0, 0, struct.pack(">I", largest - 65535))
            + _frame(1, 4, 1, headers)
            + _frame(0, 1, 1, b"\0" * 5)  # an empty message
        )

    def read(self, least: int) -> bytes:
        """Read at least so many bytes; fewer if the server ends."""
        got = bytearray()
        while len(got) < least and (data := self.socket.recv(1 << 16)):
            got += data
        return bytes(got)

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.socket.close()


def environment() -> dict[str, str]:
    """Variables for a program of the source tree."""
    root = ROOT
    return os.environ | {"PYTHONPATH": str(root)}
