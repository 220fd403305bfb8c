"""Pages of other sites, at the server of a live view."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest
import viser
from waiting import until
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from osik_jax.viewer.live import _server
from osik_jax.viewer.live._server import close_server, is_own_page, open_server


@pytest.fixture(scope="module")
def server() -> Iterator[Any]:
    server = open_server("127.0.0.1", 0, "test")
    yield server
    close_server(server)


def opened(server: Any, origin: str | None) -> ClientConnection:
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    page = None if origin is None else Origin(origin)
    return connect(f"ws://127.0.0.1:{server.get_port()}", subprotocols=[protocol], origin=page, max_size=None)


def moved(position: list[float]) -> bytes:
    fields = {"type": "TransformControlsUpdateMessage", "name": "/hand", "wxyz": [1, 0, 0, 0], "position": position}
    return msgspec.msgpack.encode(fields)


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1"])
def test_a_page_of_another_site_moves_nothing(
    server: Any, origin: str, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    tell = _server._tell
    # The page's message arrives before the refusal, and waits to be read.
    monkeypatch.setattr(_server, "_tell", lambda text: (time.sleep(0.2), tell(text)))
    handle = server.scene.add_transform_controls("/hand")
    with opened(server, origin) as page, pytest.raises(ConnectionClosed, match="a page of another site"):
        page.send(moved([1.0, 2.0, 3.0]))
        while True:
            page.recv(timeout=10.0)
    assert tuple(handle.position) == (0.0, 0.0, 0.0)
    assert f"osik view: refused a connection from a page of {origin}" in capfd.readouterr().err


def test_a_message_that_cannot_be_read_ends_no_other_visit(server: Any) -> None:
    """Only the connection that it came by."""
    handle, own = server.scene.add_transform_controls("/hand"), f"http://127.0.0.1:{server.get_port()}"
    with opened(server, own) as visitor:
        for message in ("text", b"\xff\x00junk", msgspec.msgpack.encode({"type": "TransformControlsUpdateMessage"})):
            with opened(server, own) as other, pytest.raises(ConnectionClosed):
                other.send(message)
                while True:
                    other.recv(timeout=10.0)
        visitor.send(moved([1.0, 2.0, 3.0]))
        assert until(lambda: tuple(handle.position) == (1.0, 2.0, 3.0))


@pytest.mark.parametrize(
    ("origin", "host", "listens_at", "own"),
    [
        (None, "127.0.0.1:8080", "127.0.0.1", True),
        ("http://localhost:8080", "localhost:8080", "127.0.0.1", True),
        ("http://localhost:9000", "localhost:9000", "127.0.0.1", True),  # a forwarded port
        ("http://[::1]:8080", "[::1]:8080", "::1", True),
        ("http://robot.lan:8080", "robot.lan:8080", "0.0.0.0", True),
        ("http://localhost:3000", "localhost:8080", "127.0.0.1", False),
        ("http://robot.lan.evil.example", "robot.lan:8080", "0.0.0.0", False),
        ("http://evil.example:8080", "evil.example:8080", "127.0.0.1", False),  # DNS rebinding
        ("null", "127.0.0.1:8080", "127.0.0.1", False),
    ],
)
def test_own_pages(origin: str | None, host: str, listens_at: str, own: bool) -> None:
    assert is_own_page(origin, host, listens_at) is own
