"""Serving: page and channel of a session, at ports that are bound already."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

from app.control.channel import Channel
from app.control.page import NO_VISER, ControlPage

if TYPE_CHECKING:
    from app.control.ports import Ports
    from app.control.session import Session


@contextmanager
def serve_controls(session: "Session", ports: "Ports", token: str | None) -> Iterator[list[str]]:
    """Serve until the context ends; gives what a user is to be told.

    Raises:
        InputError: this viser cannot be used, or a token is needed.
    """
    with ExitStack() as servers:
        servers.callback(ports.close)
        channel = Channel(session, ports.channel, token)
        servers.callback(channel.close)
        addresses = [f"commands as JSON lines: {channel.host}:{channel.port}"]
        if ports.page is None:
            addresses.append(NO_VISER)
        else:
            page = ControlPage(session, ports.page)
            servers.callback(page.close)
            session.on_rejected.append(page.tell)
            addresses.append(f"page: {page.url}")
        yield addresses
