"""Web server of a page, on exactly the requested port, and which other pages may connect to it."""

from __future__ import annotations

import contextlib
import importlib
import io
import ipaddress
import socket
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from ..._errors import missing_extra

if TYPE_CHECKING:
    from viser import ViserServer

_BLUE = (28, 111, 184)
POLICY_VIOLATION = 1008
"""Close code of a websocket (RFC 6455, 7.4.1)."""
_LONGEST = 120
"""Characters of a reason that are printed."""


def import_viser() -> ModuleType:
    """Return the module viser, or raise ImportError that names the extra."""
    try:
        return importlib.import_module("viser")
    except ImportError as missing:
        raise missing_extra("a live view", "viser", "viewer") from missing


def open_server(host: str, port: int, title: str) -> ViserServer:
    """Start a server with a title; exceptions are those of ``import_viser`` and ``check_port``."""
    viser = import_viser()
    free = check_port(host, port)
    with contextlib.redirect_stdout(io.StringIO()):  # its own greeting
        server = viser.ViserServer(host=host, port=free, label=title, verbose=False)
    if server.get_port() != free:
        server.stop()
        raise OSError(f"port {free} of {host} is in use: choose another")
    guard(server)
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium", brand_color=_BLUE)
    return server


def close_server(server: ViserServer) -> None:
    """Stop a server without printing."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def check_port(host: str, port: int) -> int:
    """Return the port, or a free one for 0; raise an error if it is in use."""
    if not 0 <= port < 2**16:
        raise OSError(f"there is no port {port}: ports are 1 to 65535, 0 is any that is free")
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
            return int(probe.getsockname()[1])
    except socket.gaierror as error:
        raise OSError(f"{host} is no address of this machine") from error
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise OSError(f"cannot listen at {host}, port {port}: {reason}") from error


def guard(server: Any) -> None:
    """Refuse connections of pages of other sites, with one line on stderr each.

    viser has no option for it. Its websocket server awaits this callback before it reads the first message.
    """
    sockets = server._websock_server

    async def admit(client: Any) -> None:
        connection = sockets._live_connections[client.client_id]
        headers = connection.request.headers
        if not is_own_page(headers.get("Origin"), headers.get("Host", ""), sockets._host):
            _tell(f"refused a connection from a page of {headers.get('Origin')}: open {server_url(server)}")
            connection.recv = _nothing_of(connection)
            await connection.close(POLICY_VIOLATION, "a page of another site")

    sockets.on_client_connect(admit)


def server_url(server: Any) -> str:
    """Return the address of a server's page."""
    return f"http://{server.get_host()}:{server.get_port()}"


def is_own_page(origin: str | None, host: str, listens_at: str) -> bool:
    """Return whether a connection comes from the server's own page, or from a program that is no browser.

    ``origin`` and ``host`` are headers of the request: browsers always send the first, the second is the address that
    was opened. A server that listens at this machine alone is opened by no other name, so that a foreign name that
    resolves to this machine (DNS rebinding) is refused.
    """
    if origin is None:
        return True
    page, opened = urlsplit(origin), urlsplit(f"//{host}")
    return page.netloc.lower() == host.lower() and (not _is_loopback(listens_at) or _is_loopback(opened.hostname or ""))


def _is_loopback(name: str) -> bool:
    try:
        return ipaddress.ip_address(name).is_loopback
    except ValueError:
        return name.lower() == "localhost"


def _nothing_of(connection: Any) -> Any:
    """Return a function that ends a closed connection's reader; ``recv`` would first hand out what had arrived."""

    async def end() -> bytes:
        await connection.wait_closed()
        raise connection.protocol.close_exc

    return end


def _tell(text: str) -> None:
    print(f"osik view: {' '.join(text.split())[:_LONGEST]}", file=sys.stderr, flush=True)
