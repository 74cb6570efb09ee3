"""Channel: commands to a running session from scripts and bridges to devices, over TCP.

One JSON object a line in, `app/control/commands.py` says which; one a line out: {"ok": true}, which
means queued, or {"error": "one sentence"}.  The line {"query": "figures"} answers
{"figures": {...}}.  Where a line has an "id" its reply has it too, and what became of a command
follows in a line of its own: {"id": 7, "applied": {...}, "step": 12, "time": 0.001}, or
{"id": 7, "refused": "one sentence", ...}.
"""

import asyncio
import contextlib
import hmac
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Union, cast

import msgspec

from app.control.ports import require_token
from taichi_sph.errors import InputError

if TYPE_CHECKING:
    from app.control.session import Session

LONGEST_LINE = 64 << 10
"""Bytes of a line."""
MOST_CLIENTS = 16
RATE = 1000.0
"""Lines served in a second, of all clients together; more of them wait unread [1/s]."""
BURST = 0.02
"""Part of a second whose lines may come at once [s]."""
CLIENT_TIMEOUT = 5.0
"""Longest wait for a client that does not read its replies, or does not show its token [s]."""
REJECTED_TIMEOUT = 0.5
"""Longest wait for a rejected client to read why [s]."""
_KEEPALIVE = (30, 10, 3)
"""A client that is gone without a word is noticed by asking after so long a silence [s], again
each so long [s], so many times."""
QUERIES = ("figures",)
_TOO_MANY = f"{MOST_CLIENTS} clients are connected already; try again when one has left"
_TOO_LONG = f"a line has more than {LONGEST_LINE} bytes; one command is one line"
_NO_JSON = "the first line is no JSON object; this port speaks neither HTTP nor TLS"
_NO_TOKEN = 'the token is wrong or absent; the first line must be {"token": "..."}'

LONGEST_ID = 64
Id = Union[
    Annotated[int, msgspec.Meta(ge=-(2**53), le=2**53)],
    Annotated[str, msgspec.Meta(max_length=LONGEST_ID)],
]
"""What a client calls a command by."""
_BROKEN = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)


class _Token(msgspec.Struct, forbid_unknown_fields=True):
    token: str


@dataclass(frozen=True)
class Request:
    """What a line asks for: a query, or else a command."""

    command: bytes | dict[str, Any]
    """The command, which may yet turn out to be none."""
    query: str | None = None
    id: Id | None = None


def read_request(line: bytes) -> Request:
    """What a line asks for.

    Raises:
        InputError: a query or an id that is none, and what is allowed.
    """
    # Most lines are commands without an id: they are decoded once.
    if b'"query"' not in line and b'"id"' not in line:
        return Request(line)
    try:
        table = msgspec.json.decode(line)
    except _BROKEN:
        return Request(line)
    if not isinstance(table, dict):
        return Request(line)
    try:
        number = msgspec.convert(table.pop("id", None), Id | None)
    except msgspec.ValidationError as error:
        what = str(error).replace("`", "")
        raise InputError(
            f"no id: {what}; allowed are whole numbers and texts of up to {LONGEST_ID} letters"
        ) from None
    if "command" in table or "query" not in table:
        return Request(table, id=number)
    if table.keys() != {"query"} or table["query"] not in QUERIES:
        what = repr(table["query"]) if table["query"] not in QUERIES else "it has other keys"
        raise InputError(f"no query: {what}; allowed are {', '.join(QUERIES)}")
    return Request(b"", table["query"], number)


class _Client(asyncio.Protocol):
    """One client, from its first byte to its last.

    Callbacks rather than asyncio's streams: those take a fifth to a third more of a processor for
    a command, which the simulation lacks.
    """

    def __init__(self, channel: "Channel"):
        self._channel, self._loop = channel, asyncio.get_running_loop()
        self._received = bytearray()
        self._authenticated = channel.token is None
        self._spoke = self._ended = self._leaving = False
        self._awaited = 0
        """Commands of it whose fate it is yet to be told."""
        self._read_paused_by: set[str] = set()
        self._timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        keep_alive(transport.get_extra_info("socket"))
        clients = self._channel.clients
        clients.add(self)
        if len(clients) > MOST_CLIENTS:
            self._reject(_TOO_MANY)
        elif not self._authenticated:
            self._start_timer(CLIENT_TIMEOUT, lambda: self._reject(_NO_TOKEN))

    def connection_lost(self, _: Exception | None) -> None:
        self._channel.clients.discard(self)
        self._stop_timer()

    def data_received(self, data: bytes) -> None:
        # A rejected client's is thrown away: closed with bytes unread, its reply would be lost.
        if not self._leaving:
            self._received += data
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
            self._pause_reading("unread")
            self._start_timer(CLIENT_TIMEOUT, self.transport.abort)

    def resume_writing(self) -> None:
        if not self._leaving:
            self._stop_timer()
            # Not at once: the transport is still writing, and a close now would end it twice.
            self._loop.call_soon(self._resume_reading, "unread")

    def _start_timer(self, patience: float, then: Callable[[], None]) -> None:
        """Do something after so long [s], instead of what was to be done."""
        self._stop_timer()
        self._timer = self._loop.call_later(patience, then)

    def _stop_timer(self) -> None:
        if self._timer:
            self._timer.cancel()

    def _pause_reading(self, why: str) -> None:
        self._read_paused_by.add(why)
        self.transport.pause_reading()

    def _resume_reading(self, why: str) -> None:
        self._read_paused_by.discard(why)
        try:
            self._serve()
            if not self._read_paused_by:
                self.transport.resume_reading()
        except BaseException:
            self.transport.abort()  # asyncio does so only for what it has read itself
            raise

    def _serve(self) -> None:
        """Answer the lines that have come, as far as is allowed."""
        while not (self._read_paused_by or self._leaving or self.transport.is_closing()):
            end = self._received.find(b"\n")
            length = end if end >= 0 else len(self._received)
            if length > LONGEST_LINE:
                self._reject(_TOO_LONG)
            elif end >= 0 or (self._ended and length):
                line = bytes(self._received[:length])
                del self._received[: length + 1]
                self._take(line)
            elif self._ended and not self._awaited:
                self._close_after(CLIENT_TIMEOUT)
                self.transport.close()
            else:
                return

    def _take(self, line: bytes) -> None:
        if not self._spoke and line.lstrip()[:1] != b"{":
            # A web page can make a browser send here: what is no JSON at once gets no say.
            self._reject(_NO_JSON)
            return
        self._spoke = True
        if self._authenticated:
            self._answer(line)
            if delay := self._channel.throttle_delay():
                self._pause_reading("rate")
                self._loop.call_later(delay, self._resume_reading, "rate")
        elif self._channel.is_token(line):
            self._authenticated = True
            self._stop_timer()
            self._reply({"ok": True})
        else:
            self._reject(_NO_TOKEN)

    def _answer(self, line: bytes) -> None:
        """Do what a line says."""
        number: Id | None = None
        try:
            request = read_request(line)
            number = request.id
            if request.query is not None:
                reply: dict[str, Any] = {request.query: self._channel.session.status()}
            else:
                self._submit(request)
                reply = {"ok": True}
        except InputError as error:
            reply = {"error": str(error)}
        self._reply(reply if number is None else reply | {"id": number})

    def _submit(self, request: Request) -> None:
        """Have a command applied; what became of it is told where it has an id."""
        session = self._channel.session
        if request.id is None:
            session.submit(request.command, "channel")
            return

        def on_result(result: dict[str, Any]) -> None:
            with contextlib.suppress(RuntimeError):  # the channel is closed
                self._loop.call_soon_threadsafe(self._tell, {"id": request.id} | result)

        session.submit(request.command, "channel", on_result)
        self._awaited += 1

    def _tell(self, event: dict[str, Any]) -> None:
        """Say what became of a command."""
        self._awaited -= 1
        if not (self._leaving or self.transport.is_closing()):
            self._reply(event)
            self._serve()  # it may have been all that an ended client waited for

    def _reply(self, reply: dict[str, Any]) -> None:
        # Numbers may be numpy's.
        text = msgspec.json.encode(reply, enc_hook=lambda value: value.tolist())
        self.transport.write(text + b"\n")

    def _reject(self, why: str) -> None:
        self._reply({"error": why})
        unsent = self.transport.get_write_buffer_size()
        self._close_after(CLIENT_TIMEOUT if unsent else REJECTED_TIMEOUT)
        self._read_paused_by.clear()
        self.transport.resume_reading()

    def _close_after(self, patience: float) -> None:
        """Say no more, and be gone after so long [s]."""
        self._leaving = True
        self._start_timer(patience, self.transport.abort)
        try:
            self.transport.write_eof()
        except OSError:  # it is gone already
            self.transport.abort()


class Channel:
    """A server in its own thread; the simulation never waits for it."""

    def __init__(self, session: "Session", listener: socket.socket, token: str | None = None):
        """Serve a session.

        Args:
            session: gets the commands.
            listener: a socket that listens.
            token: what a client has to know; needed where other machines reach the port.

        Raises:
            InputError: a token is needed.
        """
        self.host, self.port = listener.getsockname()[:2]
        require_token(listener, self.host, token)
        self.session, self.token = session, token
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

    def is_token(self, first: bytes) -> bool:
        """Whether a first line shows the token."""
        try:
            token = msgspec.json.decode(first, type=_Token).token
        except _BROKEN:
            return False
        return hmac.compare_digest(token.encode(), (self.token or "").encode())

    def throttle_delay(self) -> float:
        """How long who has just been served waits for its next line, for the rate's sake [s]."""
        now = self._loop.time()
        self._due = max(self._due, now) + 1.0 / RATE
        ahead = self._due - now
        return ahead - 0.5 * BURST if ahead > BURST else 0.0


def keep_alive(connection: socket.socket) -> None:
    """Have a client noticed that is gone without a word."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in zip(("IDLE", "INTVL", "CNT"), _KEEPALIVE, strict=True):
        if hasattr(socket, f"TCP_KEEP{name}"):  # macOS has other names
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, f"TCP_KEEP{name}"), value)
