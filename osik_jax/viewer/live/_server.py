"""Web server of a page, on exactly the requested port."""

from __future__ import annotations

import contextlib
import importlib
import io
import socket
import threading
import webbrowser
from abc import ABC, abstractmethod
from collections.abc import Iterable
from types import ModuleType
from typing import TYPE_CHECKING, Self

from ..._errors import missing_extra
from ._loop import ControlLoop
from ._timing import DRAWING, be_nice
from ._visitors import guard

if TYPE_CHECKING:
    from viser import GuiMarkdownHandle, ViserServer

FRAME = 1.0 / 30.0
"""Time between pictures [s]."""
WORDS = 6
"""Number of pictures between updates of the panel's text."""
_BLUE = (28, 111, 184)


class Served(ABC):
    """Base class of a page with a thread that runs ``_run`` until ``_end`` is set.

    Attributes:
        url: address of the page.
    """

    def __init__(self, host: str, port: int, title: str) -> None:
        """Start the server."""
        self._server = open_server(host, port, title)
        self.url = f"http://{host}:{self._server.get_port()}"
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._draw_all, name="osik-page", daemon=True)

    def opened(self, browser: bool) -> Self:
        """Return the page, after opening it in a browser if that is wanted."""
        if browser:
            webbrowser.open(self.url)
        return self

    def wait(self) -> None:
        """Block until ``stop`` is called elsewhere, or Ctrl-C."""
        while not self._end.wait(0.5):
            pass

    def stop(self) -> None:
        """End all threads and the server."""
        self._end.set()
        if self._thread is not threading.current_thread():
            self._thread.join(timeout=2.0)
        self._close()
        close_server(self._server)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _draw_all(self) -> None:
        be_nice(DRAWING)
        self._run()

    @abstractmethod
    def _run(self) -> None:
        """Draw in a thread of its own until ``_end`` is set."""

    def _close(self) -> None:  # noqa: B027 (a page that plays a file runs nothing)
        """End everything that runs beside the page."""


class Driving(Served):
    """Base class of a page that runs a control loop, whose handles several visitors may drag."""

    loop: ControlLoop

    def _let_go(self, visitor: int) -> None:
        """Keep the targets of a visitor who let go of a handle; stop the robot of a visitor who has left."""
        if visitor in self._server.get_clients():
            self.loop.let_go(visitor)
        else:
            self.loop.release(visitor)

    def _close(self) -> None:
        self.loop.stop()


def show_texts(texts: Iterable[tuple[GuiMarkdownHandle, str]]) -> None:
    """Show each text by its handle; one that is shown already is not sent again."""
    for handle, text in texts:
        if handle.content != text:
            handle.content = text


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
