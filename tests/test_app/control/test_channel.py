import contextlib
import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from app.cli import invoke
from app.control import channel as channel_module
from app.control.channel import BURST, LONGEST_LINE, MOST_CLIENTS, RATE, Channel
from app.control.ports import bind_ports, listen
from fake_session import PATIENCE, FakeSession, wait_until
from taichi_sph.errors import InputError

PAUSE = b'{"command": "pause"}\n'
FIGURES = b'{"query": "figures"}\n'
SOON = 2.0
"""A reply takes a millisecond; a machine that stumbles may take this [s]."""


def serve(
    session: Any, host: str = "127.0.0.1", port: int = 0, token: str | None = None
) -> Channel:
    return Channel(session, listen(host, port, "channel"), token)


class Client:
    """A connection that reads line by line."""

    def __init__(self, channel: Channel):
        self.socket = socket.create_connection((channel.host, channel.port), timeout=PATIENCE)
        self.file = self.socket.makefile("rb")

    def send(self, *lines: bytes) -> None:
        self.socket.sendall(b"".join(lines))

    def reply(self) -> Any:
        return json.loads(self.file.readline())

    def ask(self, line: bytes) -> Any:
        self.send(line)
        return self.reply()

    def at_end(self) -> bool:
        """Whether the server has closed; waits for it."""
        with suppress(ConnectionResetError):
            return self.file.read() == b""
        return True

    def close(self) -> None:
        self.file.close()
        self.socket.close()

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@pytest.fixture
def session() -> Any:
    return FakeSession("box", particles=10)


@pytest.fixture
def channel(session: Any, caplog: pytest.LogCaptureFixture) -> Iterator[Channel]:
    channel = serve(session)
    yield channel
    channel.close()
    assert [record.getMessage() for record in caplog.records if record.name == "asyncio"] == []


@pytest.fixture
def guarded(session: Any) -> Iterator[Channel]:
    channel = serve(session, token="sésame")
    yield channel
    channel.close()


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(channel_module, "CLIENT_TIMEOUT", 0.2)


def works(channel: Channel) -> bool:
    """Whether a newcomer is served, without delay."""
    with Client(channel) as client:
        begin = time.monotonic()
        return client.ask(PAUSE) == {"ok": True} and time.monotonic() - begin < SOON


def test_a_command_is_queued_and_figures_are_told(channel: Channel, session: Any) -> None:
    with Client(channel) as client:
        assert client.ask(b'{"command": "wound", "centre": [0, 0, 1e-2], "radius": 1e-3}\n') == {
            "ok": True
        }
        assert client.ask(FIGURES)["figures"]["particles"] == 10
        assert client.ask(FIGURES)["figures"]["added"] is None, "JSON knows no NaN"
    assert [c["radius"] for c in session.of("wound")] == [1e-3]
    assert session.sources == {"channel"}


def test_replies_come_in_the_order_of_the_lines(channel: Channel) -> None:
    with Client(channel) as client:
        client.send(PAUSE, FIGURES, b'{"command": "dance"}\n', PAUSE)
        kinds = [next(iter(client.reply())) for _ in range(4)]
    assert kinds == ["ok", "figures", "error", "ok"]


def test_a_client_that_ends_its_side_gets_all_replies(channel: Channel) -> None:
    with Client(channel) as client:
        client.send(PAUSE, PAUSE.strip())
        client.socket.shutdown(socket.SHUT_WR)
        assert [client.reply() for _ in range(2)] == 2 * [{"ok": True}]
        assert client.at_end()


@pytest.mark.parametrize(
    "line",
    [
        b"\n",
        b"null\n",
        b"[1, 2]\n",
        b'"pause"\n',
        b"{\n",
        b'{"command": "dance"}\n',
        b'{"command": "speed", "factor": NaN}\n',
        b'{"command": "speed", "factor": 1e999}\n',
        b'{"command": "pause", "now": true}\n',
        b'{"query": "passwords"}\n',
        b'{"query": "figures", "more": 1}\n',
        b'{"command": "\xff\xfe"}\n',
        b"\x00\x01\x02\xff\n",
        b"[" * 60_000 + b"\n",
        b'{"a": ' * 10_000 + b"\n",
    ],
    ids=lambda line: repr(line[:24]),
)
def test_what_is_no_command_is_answered_in_a_sentence(
    channel: Channel, session: Any, line: bytes
) -> None:
    with Client(channel) as client:
        assert client.ask(PAUSE) == {"ok": True}
        assert "allowed" in client.ask(line)["error"]
        assert client.ask(PAUSE) == {"ok": True}
    assert len(session.submitted) == 2


def test_a_full_queue_is_an_error_and_not_the_end(channel: Channel, session: Any) -> None:
    session.full = True
    with Client(channel) as client:
        assert "queue is full" in client.ask(PAUSE)["error"]
        session.full = False
        assert client.ask(PAUSE) == {"ok": True}


@pytest.mark.parametrize(
    "first",
    [
        b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n" + PAUSE,
        b"GET / HTTP/1.1\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\n" + PAUSE,
        b"\r\n\r\n" + PAUSE,
    ],
    ids=["POST", "GET", "TLS", "blank lines"],
)
def test_a_browser_is_sent_away_unheard(channel: Channel, session: Any, first: bytes) -> None:
    with Client(channel) as client:
        client.send(first)
        assert "no JSON object" in client.reply()["error"]
        assert client.at_end()
    assert works(channel)
    assert len(session.submitted) == 1


def test_a_line_without_end_is_cut_off(channel: Channel, session: Any) -> None:
    with Client(channel) as client:
        assert client.ask(b'{"command": "pause"' + b" " * (LONGEST_LINE - 20) + b"}\n") == {
            "ok": True
        }
        with suppress(OSError):
            for _ in range(256):
                client.send(b"{" * LONGEST_LINE)
        assert str(LONGEST_LINE) in client.reply()["error"]
        assert client.at_end()
    assert works(channel)
    assert len(session.submitted) == 2


def test_a_flood_is_served_at_its_rate_and_others_are_served_beside_it(
    channel: Channel, session: Any
) -> None:
    lines = 1500
    with Client(channel) as flood:
        begin = time.monotonic()
        flood.send(PAUSE * lines)
        flood.socket.shutdown(socket.SHUT_WR)
        assert works(channel)
        assert len(session.submitted) < lines, "the flood is still waiting"
        assert flood.file.read() == lines * b'{"ok":true}\n'
        # Nothing lost; the burst comes at once.
        assert time.monotonic() - begin > (lines / RATE - BURST) * 0.99


def test_who_never_reads_its_replies_is_closed(
    channel: Channel, session: Any, impatient: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Replies of a megabyte fill what the system holds for a connection.
    figures = session.status() | {"model": "x" * (1 << 20)}
    monkeypatch.setattr(session, "status", lambda: figures)
    with Client(channel) as client:
        client.send(FIGURES * 50)
        wait_until(lambda: not channel.clients)
        assert works(channel)


def test_who_reads_late_gets_all_replies(
    channel: Channel, session: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures = session.status() | {"model": "x" * (8 << 20)}
    monkeypatch.setattr(session, "status", lambda: figures)
    with Client(channel) as client:
        client.send(FIGURES * 2, FIGURES.strip())
        client.socket.shutdown(socket.SHUT_WR)
        time.sleep(0.3)
        assert works(channel)
        assert [len(client.reply()["figures"]["model"]) for _ in range(3)] == 3 * [8 << 20]
        assert client.at_end()
    wait_until(lambda: not channel.clients)


def test_clients_that_vanish_while_they_are_held_leave_nothing_behind(channel: Channel) -> None:
    with Client(channel) as flood:
        flood.send(PAUSE * 1000)
        for _ in range(MOST_CLIENTS):
            client = Client(channel)
            client.send(PAUSE.strip())
            client.close()
        assert len(flood.file.readline()) > 0
    wait_until(lambda: not channel.clients)
    assert works(channel)


def test_clients_that_vanish_leave_nothing_behind(channel: Channel, session: Any) -> None:
    for ending in (b"", PAUSE, PAUSE.strip(), b'{"command": "pa', FIGURES * 100):
        client = Client(channel)
        client.send(ending)
        # As when a program is killed: the connection is reset.
        client.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
        client.close()
    wait_until(lambda: not channel.clients)
    assert works(channel)


def test_a_silent_client_harms_nobody(channel: Channel) -> None:
    with Client(channel) as silent, Client(channel) as half:
        half.send(b'{"command"')
        assert works(channel)
        half.send(b': "pause"}\n')
        assert half.reply() == {"ok": True}
        assert silent.ask(PAUSE) == {"ok": True}


def test_one_client_too_many_is_told_and_closed(channel: Channel) -> None:
    clients = [Client(channel) for _ in range(MOST_CLIENTS)]
    assert all(client.ask(PAUSE) == {"ok": True} for client in clients)
    with Client(channel) as late:
        assert f"{MOST_CLIENTS} clients" in late.reply()["error"]
        assert late.at_end()
    clients.pop().close()
    wait_until(lambda: len(channel.clients) == MOST_CLIENTS - 1)
    assert works(channel)
    for client in clients:
        client.close()


def test_who_knows_the_token_is_let_in(guarded: Channel) -> None:
    with Client(guarded) as client:
        assert client.ask('{"token": "sésame"}\n'.encode()) == {"ok": True}
        assert client.ask(PAUSE) == {"ok": True}


@pytest.mark.parametrize(
    "first",
    [PAUSE, FIGURES, b'{"token": "open"}\n', b'{"token": null}\n', b'{"token": "\xff"}\n', b"{\n"],
    ids=["a command", "a query", "wrong", "null", "no text", "cut"],
)
def test_who_does_not_know_the_token_is_closed(
    guarded: Channel, session: Any, first: bytes
) -> None:
    with Client(guarded) as client:
        client.send(first, '{"token": "sésame"}\n'.encode(), PAUSE)
        assert "token" in client.reply()["error"]
        assert client.at_end()
    assert not session.submitted


def test_who_shows_no_token_for_long_is_closed(
    impatient: None, guarded: Channel, session: Any
) -> None:
    with Client(guarded) as client:
        assert "token" in client.reply()["error"]
        assert client.at_end()


def test_other_machines_need_a_token(session: Any) -> None:
    for host in ("0.0.0.0", "::"):
        with pytest.raises(InputError, match="token"):
            serve(session, host=host)
    channel = serve(session, host="localhost")
    assert channel.host in ("127.0.0.1", "::1")
    channel.close()


@pytest.mark.parametrize(
    ("host", "port"), [("", 0), ("a..b", 0), ("192.0.2.1", 0), ("127.0.0.1", 70_000), ("\0", 0)]
)
def test_an_address_that_is_none_is_refused(session: Any, host: str, port: int) -> None:
    with pytest.raises(InputError, match="channel"):
        serve(session, host=host, port=port)


def test_a_taken_port_is_refused(channel: Channel, session: Any) -> None:
    with pytest.raises(InputError, match=f"{channel.port}: no port to serve at"):
        serve(session, port=channel.port)


def test_close_ends_clients_and_thread_and_frees_the_port(session: Any) -> None:
    channel = serve(session)
    with Client(channel) as client, Client(channel) as flood:
        assert client.ask(PAUSE) == {"ok": True}
        flood.send(PAUSE * 2000)
        begin = time.monotonic()
        channel.close()
        assert time.monotonic() - begin < SOON
        assert client.at_end()
    channel.close()
    assert "channel" not in {thread.name for thread in threading.enumerate()}
    serve(session, port=channel.port).close()


# Commands with an id


def test_a_command_with_an_id_is_told_of_when_it_is_applied_and_as_it_was(
    channel: Channel, session: Any
) -> None:
    session.delay = []
    with Client(channel) as client:
        assert client.ask(b'{"command": "pause", "id": 7}\n') == {"ok": True, "id": 7}
        assert client.ask(b'{"query": "figures", "id": "a"}\n')["id"] == "a"
        session.delay.pop()()
        event = client.reply()
        assert event.pop("time") >= 0.0
        assert event == {"id": 7, "applied": {"command": "pause", "on": True}, "step": 1}
        assert client.ask(PAUSE) == {"ok": True}, "without an id there is one reply"
        assert client.ask(PAUSE) == {"ok": True}
    assert not any("id" in command for command in session.submitted)


def test_a_refusal_at_once_and_one_at_the_step_carry_the_id(channel: Channel, session: Any) -> None:
    session.refuses = "wound: the wall is 0.0136 m away"
    with Client(channel) as client:
        assert "no command" in client.ask(b'{"command": "dance", "id": 1}\n')["error"]
        client.send(b'{"command": "dance", "id": 1}\n', b'{"command": "pause", "id": 2}\n')
        assert client.reply()["id"] == 1
        assert client.reply() == {"ok": True, "id": 2}
        assert client.reply() == {"id": 2, "refused": session.refuses}


@pytest.mark.parametrize(
    "number", [b"1.5", b"[1]", b"{}", b"true", b'"' + 65 * b"x" + b'"', b"1e30"]
)
def test_an_id_that_is_none_is_refused_in_a_sentence(
    channel: Channel, session: Any, number: bytes
) -> None:
    with Client(channel) as client:
        assert "no id" in client.ask(b'{"command": "pause", "id": ' + number + b"}\n")["error"]
        assert client.ask(b'{"command": "pause", "id": null}\n') == {"ok": True}
    assert len(session.submitted) == 1


def test_who_ends_its_side_is_told_what_became_of_its_commands(
    channel: Channel, session: Any
) -> None:
    session.delay = []
    with Client(channel) as client:
        client.send(b'{"command": "pause", "id": 1}\n{"command": "step", "id": 2}')
        client.socket.shutdown(socket.SHUT_WR)
        assert [client.reply()["id"] for _ in range(2)] == [1, 2]
        wait_until(lambda: len(session.delay) == 2)
        for tell in session.delay:
            tell()
        assert [client.reply()["applied"]["command"] for _ in range(2)] == ["pause", "step"]
        assert client.at_end()


def test_results_for_clients_that_have_left_and_after_the_end_harm_nobody(
    channel: Channel, session: Any
) -> None:
    session.delay = []
    with Client(channel) as client:
        client.ask(b'{"command": "pause", "id": 1}\n')
        client.ask(b'{"command": "pause", "id": 2}\n')
    session.delay.pop()()
    assert works(channel)
    channel.close()
    session.delay.pop()()


def test_an_unknown_query_says_which_there_are(channel: Channel) -> None:
    with Client(channel) as client:
        for query in (b'{"query": "state"}', b'{"query": 3}', b'{"query": "figures", "at": 1}'):
            answer = client.ask(query + b"\n")["error"]
            assert answer.startswith("no query: ") and answer.endswith("allowed are figures")
        # A word in a command is no query.
        command = b'{"command": "inflow", "opening": "query", "factor": 1}\n'
        assert client.ask(command) == {"ok": True}


# Ports


def test_ports_that_are_taken_are_told_with_one_that_is_free(session: Any) -> None:
    with (
        contextlib.closing(listen("127.0.0.1", 0, "test")) as page,
        contextlib.closing(listen("127.0.0.1", 0, "test")) as channel,
    ):
        for taken, asked in ((page, 0), (channel, -1)):
            port = taken.getsockname()[1]
            with pytest.raises(InputError) as error:
                bind_ports(port + asked, "127.0.0.1", None)
            assert f"port {port} of 127.0.0.1 cannot be had" in str(error.value)
            free = int(str(error.value).split("--control ")[-1].split()[0])
            assert free not in (port, port - 1)
            bind_ports(free, "127.0.0.1", None).close()
            # What was bound before the refusal is given back.
            with pytest.raises(InputError, match="cannot be had"):
                bind_ports(port + asked, "127.0.0.1", None)


def test_a_host_without_a_token_or_that_is_none_binds_nothing(monkeypatch: Any) -> None:
    port = bind_free()
    for host, why in (("0.0.0.0", "token"), ("a..b", "no port to serve at"), ("192.0.2.1", "no")):
        with pytest.raises(InputError, match=why):
            bind_ports(port, host, None)
        bind_ports(port, "127.0.0.1", None).close()
    bind_ports(port, "0.0.0.0", "a token").close()


def bind_free() -> int:
    """A port that is free together with the next."""
    with contextlib.closing(listen("127.0.0.1", 0, "test")) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InputError) as error:
            bind_ports(port, "127.0.0.1", None)
    return int(str(error.value).split("--control ")[-1].split()[0])


def test_a_start_that_is_refused_touches_no_file_and_says_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    recording = b"RRF2 an earlier recording"
    Path("a.rrd").write_bytes(recording)
    with contextlib.closing(listen("127.0.0.1", 0, "test")) as taken:
        port = taken.getsockname()[1]
        for more in (["--control", port], ["--control", port - 1]):
            sentence, code = invoke(["run", "box", "--rrd", "a.rrd", *map(str, more)])
            assert code == 2 and "cannot be had" in sentence and "is free" in sentence
    free = ["--control", str(bind_free()), "--host", "0.0.0.0"]
    sentence, code = invoke(["run", "box", "--rrd", "a.rrd", *free])
    assert code == 2 and "token" in sentence
    assert [file.name for file in tmp_path.iterdir()] == ["a.rrd"]
    assert Path("a.rrd").read_bytes() == recording
    assert capfd.readouterr() == ("", "")
