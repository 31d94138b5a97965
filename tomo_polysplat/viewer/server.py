"""Serves the page to this machine: fixed addresses, reading only, nothing from outside."""

from __future__ import annotations

import json
import secrets
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any

from tomo_polysplat.report.page import text
from tomo_polysplat.viewer.volumes import Shown

__all__ = ["Server"]

_ASSETS = {"view.js": "text/javascript", "view.css": "text/css"}
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
_NOT_FOUND = (404, "text/plain", b"not found")


class Server(ThreadingHTTPServer):
    """A page about volumes on 127.0.0.1, at an address that nobody else on the machine can guess.

    Parameters
    ----------
    shown : Shown
    port : int
        0 for any that is free.

    Raises
    ------
    OSError
        If the port is taken.
    """

    daemon_threads = True

    def __init__(self, shown: Shown, port: int = 0) -> None:
        super().__init__(("127.0.0.1", port), _Handler)
        self.shown, self.secret = shown, secrets.token_urlsafe(16)
        self._page = _page(shown)

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://127.0.0.1:{self.server_port}/{self.secret}/"

    def hosts(self) -> set[str]:
        """Names under which it may be asked: a page from elsewhere that renames this machine has another."""
        return {f"127.0.0.1:{self.server_port}", f"localhost:{self.server_port}"}

    def answer(self, path: str) -> tuple[int, str, bytes]:
        """Status, type and content of an address below the secret."""
        if path == "":
            return 200, "text/html; charset=utf-8", self._page
        if path in _ASSETS:
            content = (files("tomo_polysplat.viewer") / path).read_bytes()
            return 200, f"{_ASSETS[path]}; charset=utf-8", content
        if path == "about.json":
            return 200, "application/json", json.dumps(self.shown.about()).encode()
        if path.startswith("slice/"):
            return self._slice(path.removeprefix("slice/"))
        return _NOT_FOUND

    def _slice(self, path: str) -> tuple[int, str, bytes]:
        """``volume/axis/index`` of numbers that there are."""
        parts = path.split("/")
        if len(parts) != 3 or not all(part.isascii() and part.isdigit() and len(part) < 8 for part in parts):
            return _NOT_FOUND
        volume, axis, index = map(int, parts)
        if volume >= len(self.shown.volumes) or axis > 2 or index >= self.shown.shape[axis]:
            return _NOT_FOUND
        return 200, "application/octet-stream", self.shown.slice(volume, axis, index)


class _Handler(BaseHTTPRequestHandler):
    server: Server
    # Connections stay, and small answers do not wait for others to go with them.
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def do_GET(self) -> None:  # noqa: N802  # its name in the library
        """Answer."""
        known = self.headers.get("Host", "") in self.server.hosts()
        _, secret, path = ("/" + self.path.lstrip("/") + "/").split("/", 2)
        right = secrets.compare_digest(secret.encode("utf-8", "replace"), self.server.secret.encode())
        self._send(*(self.server.answer(path.rstrip("/")) if known and right else _NOT_FOUND))

    def _send(self, status: int, kind: str, content: bytes) -> None:
        self.send_response(status)
        for name, value in (_HEADERS | {"Content-Type": kind, "Content-Length": str(len(content))}).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)

    def version_string(self) -> str:
        """Which software this is, without versions."""
        return "tomo-polysplat"

    log_message: Callable[..., Any] = lambda *_: None  # noqa: E731  # nobody reads who asked for which slice


def _page(shown: Shown) -> bytes:
    template = (files("tomo_polysplat.viewer") / "page.html").read_text(encoding="utf-8")
    return template.replace("@TITLE@", text(shown.title)).replace("@BELOW@", shown.html).encode()
