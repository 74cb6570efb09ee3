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
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal, cast

import msgspec

from taichi_sph.errors import InputError

if TYPE_CHECKING:
    from app.control.session import Session

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
_TOO_MANY = f"{MOST_CLIENTS} clients are connected already; try again when one has left"
_TOO_LONG = f"a line has more than {LONGEST_LINE} bytes; one command is one line"
_NO_JSON = "the first line is no JSON object; this port speaks neither HTTP nor TLS"
_NO_TOKEN = 'the token is wrong or absent; the first line must be {"token": "..."}'


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


class _Client(asyncio.Protocol):
    """One client, from its first byte to its last."""

    def __init__(self, channel: "Channel"):
        self._channel, self._loop = channel, asyncio.get_running_loop()
        self._came = bytearray()
        self._known = channel.token is None
        self._spoke = self._ended = self._leaving = False
        self._holds: set[str] = set()
        """Why nothing of it is served for now."""
        self._timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        line = transport.get_extra_info("socket")
        line.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in zip(("IDLE", "INTVL", "CNT"), _ALIVE, strict=True):
            if hasattr(socket, f"TCP_KEEP{name}"):  # macOS has other names
                line.setsockopt(socket.IPPROTO_TCP, getattr(socket, f"TCP_KEEP{name}"), value)
        clients = self._channel.clients
        clients.add(self)
        if len(clients) > MOST_CLIENTS:
            self._send_away(_TOO_MANY)
        elif not self._known:
            self._wait(_PATIENCE, lambda: self._send_away(_NO_TOKEN))

    def connection_lost(self, _: Exception | None) -> None:
        self._channel.clients.discard(self)
        self._wait_no_more()

    def data_received(self, data: bytes) -> None:
        # Of who is sent away it is thrown away: closed with bytes unread, its reply would be lost.
        if not self._leaving:
            self._came += data
            self._serve()

    def eof_received(self) -> bool:
        self._ended = True
        if self._leaving:
            return False
        self._serve()
        return True

    def pause_writing(self) -> None:
        """Replies that nobody reads fill the buffers; this waits for that, not for ever."""
        if not self._leaving:
            self._hold("unread")
            self._wait(_PATIENCE, self.transport.abort)

    def resume_writing(self) -> None:
        if not self._leaving:
            self._wait_no_more()
            # Not at once: the transport is still writing, and a close now would end it twice.
            self._loop.call_soon(self._go_on, "unread")

    def _wait(self, patience: float, then: Callable[[], None]) -> None:
        """Do something after so long [s], instead of what was to be done."""
        self._wait_no_more()
        self._timer = self._loop.call_later(patience, then)

    def _wait_no_more(self) -> None:
        if self._timer:
            self._timer.cancel()

    def _hold(self, why: str) -> None:
        self._holds.add(why)
        self.transport.pause_reading()

    def _go_on(self, why: str) -> None:
        self._holds.discard(why)
        try:
            self._serve()
            if not self._holds:
                self.transport.resume_reading()
        except BaseException:
            self.transport.abort()  # asyncio does so only for what it has read itself
            raise

    def _serve(self) -> None:
        """Answer the lines that have come, as far as is allowed."""
        while not (self._holds or self._leaving or self.transport.is_closing()):
            end = self._came.find(b"\n")
            length = end if end >= 0 else len(self._came)
            if length > LONGEST_LINE:
                self._send_away(_TOO_LONG)
            elif end >= 0 or (self._ended and length):
                line = bytes(self._came[:length])
                del self._came[: length + 1]
                self._take(line)
            elif self._ended:
                self._leave(_PATIENCE)
                self.transport.close()
            else:
                return

    def _take(self, line: bytes) -> None:
        if not self._spoke and line.lstrip()[:1] != b"{":
            # A web page can make a browser send here: what is no JSON at once gets no say.
            self._send_away(_NO_JSON)
            return
        self._spoke = True
        if self._known:
            self._reply(self._channel.answer(line))
            if wait := self._channel.turn():
                self._hold("rate")
                self._loop.call_later(wait, self._go_on, "rate")
        elif self._channel.knows(line):
            self._known = True
            self._wait_no_more()
            self._reply({"ok": True})
        else:
            self._send_away(_NO_TOKEN)

    def _reply(self, reply: dict[str, Any]) -> None:
        # Numbers may be numpy's.
        text = msgspec.json.encode(reply, enc_hook=lambda value: value.tolist())
        self.transport.write(text + b"\n")

    def _send_away(self, why: str) -> None:
        self._reply({"error": why})
        self._leave(_PATIENCE if self.transport.get_write_buffer_size() else _LINGER)
        self._holds.clear()
        self.transport.resume_reading()

    def _leave(self, patience: float) -> None:
        """Say no more, and be gone after so long [s]."""
        self._leaving = True
        self._wait(patience, self.transport.abort)
        try:
            self.transport.write_eof()
        except OSError:  # it is gone already
            self.transport.abort()


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
        self._session, self.token = session, token
        self.clients: set[_Client] = set()
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
        server = await self._loop.create_server(lambda: _Client(self), sock=listener)
        self._ready.set()
        await self._closing.wait()
        server.close()
        for client in self.clients:
            client.transport.abort()

    def knows(self, first: bytes) -> bool:
        """Whether a first line shows the token."""
        try:
            given = msgspec.json.decode(first, type=_Token).token
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return False
        return hmac.compare_digest(given.encode(), (self.token or "").encode())

    def turn(self) -> float:
        """How long who has just been served waits for its next line, for the rate's sake [s]."""
        now = self._loop.time()
        self._due = max(self._due, now) + 1.0 / RATE
        ahead = self._due - now
        return ahead - 0.5 * _BURST if ahead > _BURST else 0.0

    def answer(self, line: bytes) -> dict[str, Any]:
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
