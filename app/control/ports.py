"""Ports: where page and channel are served; bound before anything is said or written."""

import errno
import importlib.util
import ipaddress
import socket
from dataclasses import dataclass

from taichi_sph.errors import InputError

PAGE_HOST = "127.0.0.1"
"""The page has no password."""
_TRIED = 100
"""Pairs of ports that are tried when one to use instead is looked for."""


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
        return _bind(host, port)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{option} {host}:{port}: no port to serve at: {reason}") from None


def _bind(host: str, port: int) -> socket.socket:
    family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    return socket.create_server(address[:2], family=family)


def is_loopback(listener: socket.socket) -> bool:
    """Whether only this machine reaches a socket."""
    return ipaddress.ip_address(listener.getsockname()[0]).is_loopback


def require_token(listener: socket.socket, host: str, token: str | None) -> None:
    """Refuse a channel that other machines reach and that asks for no token.

    Raises:
        InputError: what may be done instead.
    """
    if not is_loopback(listener) and not token:
        listener.close()
        raise InputError(
            f"channel {host}: other machines reach this address; give a token that clients "
            "have to know, or serve at 127.0.0.1"
        )


@dataclass(frozen=True)
class Ports:
    """Sockets that listen, of a page and a channel that are yet to be served."""

    page: socket.socket | None
    """None where viser, which shows pages, is not installed."""
    channel: socket.socket

    def close(self) -> None:
        """Give the ports back."""
        for listener in (self.page, self.channel):
            if listener is not None:
                listener.close()


def bind_ports(port: int, host: str, token: str | None) -> Ports:
    """Bind the page's port on loopback and, at `host`, the channel's, which is the next.

    Args:
        port: the page's.
        host: address of the channel.
        token: what the channel's clients have to know.

    Raises:
        InputError: a port is taken, which is told with one that is free, there is no such host,
            or a token is needed.
    """
    page = None
    try:
        if importlib.util.find_spec("viser") is not None:
            page = _require(PAGE_HOST, port, port, host)
        channel = _require(host, port + 1, port, host)
        require_token(channel, host, token)
    except InputError:
        if page is not None:
            page.close()
        raise
    return Ports(page, channel)


def _require(address: str, port: int, asked: int, host: str) -> socket.socket:
    """A socket at a port, for a page that is asked for at `asked`."""
    try:
        return _bind(address, port)
    except OSError as error:
        if error.errno in (errno.EADDRINUSE, errno.EACCES):
            free = _free_port(asked, host)
            way_out = f"; --control {free} is free" if free else ""
            raise InputError(
                f"--control {asked}: port {port} of {address} cannot be had: {error.strerror}"
                f"{way_out}"
            ) from None
    except UnicodeError:
        pass
    return listen(address, port, "channel")  # says what is wrong with the address


def _free_port(asked: int, host: str) -> int | None:
    """A port that is free, with the next one, for page and channel."""
    # Ports below 1024 are the system's.
    first = max(asked + 2, 1024)
    for port in range(first, min(first + 2 * _TRIED, 65534), 2):
        try:
            with _bind(PAGE_HOST, port), _bind(host, port + 1):
                return port
        except OSError:
            continue
    return None
