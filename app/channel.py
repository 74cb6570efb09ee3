"""Channel: commands to a running session from scripts and bridges to devices, over TCP.

One JSON object a line in, `app/commands.py` says which; one a line out: {"ok": true}, which means
queued, or {"error": "one sentence"}.  The line {"query": "figures"} answers {"figures": {...}}.
"""

import asyncio
import contextlib
import hmac
import ipaddress
import socket
import threading
from typing import TYPE_CHECKING, Any, Literal

import msgspec

from taichi_sph.errors import InputError

if TYPE_CHECKING:
    from app.session import Session

LONGEST_LINE = 64 << 10
"""Bytes of a line."""
MOST_CLIENTS = 16
RATE = 1000.0
"""Lines served in a second, of all clients together; more of them wait unread [1/s]."""
_BURST = 0.02
"""Of the rate, so much may come at once [s]."""
_PATIENCE = 5.0
"""Longest wait for a client that does not read its replies, or does not show its token [s]."""
_LINGER = 0.5
"""Longest wait for a refused client to read why [s]."""
_ALIVE = (30, 10, 3)
"""A client that is gone without a word is noticed by: asking after so long a silence [s], again
each so long [s], so many times."""


class _Query(msgspec.Struct, forbid_unknown_fields=True):
    query: Literal["figures"]


class _Token(msgspec.Struct, forbid_unknown_fields=True):
    token: str


def listen(host: str, port: int, option: str) -> socket.socket:
    """A socket that listens; port 0 is any free one.

    Raises:
        InputError: the port is taken, or there is no such host.
    """
    if not (host and 0 <= port <= 65535):
        raise InputError(
            f"{option} {host}:{port}: give an address, as 127.0.0.1, and a port from 0 to 65535"
        )
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        return socket.create_server(address[:2], family=family)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{option} {host}:{port}: no port to serve at: {reason}") from None


def is_loopback(listener: socket.socket) -> bool:
    """Whether only this machine reaches a socket."""
    return ipaddress.ip_address(listener.getsockname()[0]).is_loopback


class Channel:
    """A server in its own thread; the simulation never waits for it."""

    def __init__(
        self, session: "Session", host: str = "127.0.0.1", port: int = 0, token: str | None = None
    ):
        """Serve a session.

        Args:
            session: gets the commands.
            host: address to serve at.
            port: 0 is any free one.
            token: what a client has to know; needed where other machines reach the port.

        Raises:
            InputError: the port is taken, or a token is needed.
        """
        listener = listen(host, port, "channel")
        if not is_loopback(listener) and not token:
            listener.close()
            raise InputError(
                f"channel {host}: other machines reach this address; give a token that clients "
                "have to know, or serve at 127.0.0.1"
            )
        self.host, self.port = listener.getsockname()[:2]
        self._session, self._token = session, token
        self._clients: set[asyncio.StreamWriter] = set()
        self._due = 0.0
        self._ready = threading.Event()
        self._thread = threading.Thread(
            target=lambda: asyncio.run(self._serve(listener)), daemon=True, name="channel"
        )
        self._thread.start()
        self._ready.wait()

    def close(self) -> None:
        """End the server and all its clients."""
        with contextlib.suppress(RuntimeError):  # closed before
            self._loop.call_soon_threadsafe(self._closing.set)
        self._thread.join()

    async def _serve(self, listener: socket.socket) -> None:
        self._loop, self._closing = asyncio.get_running_loop(), asyncio.Event()
        server = await asyncio.start_server(self._meet, sock=listener, limit=LONGEST_LINE)
        self._ready.set()
        await self._closing.wait()
        server.close()
        # Cancelling them is not enough: before Python 3.12 wait_for may swallow it.
        for writer in self._clients:
            writer.transport.abort()

    async def _meet(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One client, from its first byte to its last."""
        self._clients.add(writer)
        try:
            line = writer.get_extra_info("socket")
            line.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            for name, value in zip(("IDLE", "INTVL", "CNT"), _ALIVE, strict=True):
                if hasattr(socket, f"TCP_KEEP{name}"):  # macOS has other names
                    line.setsockopt(socket.IPPROTO_TCP, getattr(socket, f"TCP_KEEP{name}"), value)
            refused = await self._talk(reader, writer)
            if refused:
                await self._reply(writer, {"error": refused})
            writer.write_eof()
            await asyncio.wait_for(self._drop(reader), _LINGER)
        except (OSError, asyncio.TimeoutError, asyncio.CancelledError):
            pass  # gone, as good as gone, or the channel closes
        finally:
            self._clients.remove(writer)
            writer.transport.abort()

    async def _talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> str:
        """Serve a client until it ends; or why it is sent away."""
        if len(self._clients) > MOST_CLIENTS:
            return f"{MOST_CLIENTS} clients are connected already; try again when one has left"
        try:
            line = await self._line(reader, _PATIENCE if self._token else None)
            if line and line.lstrip()[:1] != b"{":
                # A web page can make a browser send here: what is no JSON at once gets no say.
                return "the first line is no JSON object; this port speaks neither HTTP nor TLS"
            if self._token:
                if not self._knows(line):
                    return 'the token is wrong or absent; the first line must be {"token": "..."}'
                await self._reply(writer, {"ok": True})
                line = await self._line(reader)
            while line:
                await self._turn()
                await self._reply(writer, self._answer(line))
                line = await self._line(reader)
        except asyncio.LimitOverrunError:
            return f"a line has more than {LONGEST_LINE} bytes; one command is one line"
        return ""

    @staticmethod
    async def _line(reader: asyncio.StreamReader, patience: float | None = None) -> bytes:
        """The next line; at the end, or after so long [s], what there is of it."""
        try:
            return await asyncio.wait_for(reader.readuntil(), patience)
        except asyncio.IncompleteReadError as end:
            return end.partial
        except asyncio.TimeoutError:
            return b""

    def _knows(self, first: bytes) -> bool:
        """Whether a first line shows the token."""
        try:
            given = msgspec.json.decode(first, type=_Token).token
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return False
        return hmac.compare_digest(given.encode(), (self._token or "").encode())

    async def _turn(self) -> None:
        """Keep to the rate; meanwhile nothing more is read of this client."""
        now = self._loop.time()
        self._due = max(self._due, now) + 1.0 / RATE
        if self._due > now + _BURST:
            await asyncio.sleep(self._due - now - 0.5 * _BURST)

    def _answer(self, line: bytes) -> dict[str, Any]:
        """Do what a line says."""
        if b"query" in line:  # no command has such a word
            with contextlib.suppress(msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
                msgspec.json.decode(line, type=_Query)
                return {"figures": self._session.figures()}
        try:
            self._session.offer(line, "channel")
        except InputError as error:
            return {"error": str(error)}
        return {"ok": True}

    @staticmethod
    async def _reply(writer: asyncio.StreamWriter, reply: dict[str, Any]) -> None:
        # Numbers may be numpy's.
        writer.write(msgspec.json.encode(reply, enc_hook=lambda value: value.tolist()) + b"\n")
        if writer.is_closing() or writer.transport.get_write_buffer_size():
            # Replies that nobody reads fill the buffers; then this waits, not for ever.
            await asyncio.wait_for(writer.drain(), _PATIENCE)

    @staticmethod
    async def _drop(reader: asyncio.StreamReader) -> None:
        """Throw away what still comes: closed with bytes unread, a connection loses its reply."""
        for _ in range(64):
            if not await reader.read(LONGEST_LINE):
                return
