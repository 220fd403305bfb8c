"""Web server of a page, on exactly the requested port."""

from __future__ import annotations

import contextlib
import importlib
import io
import socket
from types import ModuleType
from typing import TYPE_CHECKING

from ..._errors import missing_extra
from ._visitors import guard

if TYPE_CHECKING:
    from viser import ViserServer

_BLUE = (28, 111, 184)


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
