"""Which web pages may open a live view's connection."""

from __future__ import annotations

import ipaddress
import sys
from typing import Any
from urllib.parse import urlsplit

POLICY_VIOLATION = 1008
"""Close code of a websocket (RFC 6455, 7.4.1)."""
_LONGEST = 120
"""Characters of a reason that are printed."""


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
