"""A page in the browser of this machine: access, permitted content, and time limits of connections.

The pages that commands serve share it. Each is one HTML file with its own script and style, which loads nothing else.
"""

from __future__ import annotations

import base64
import contextlib
import functools
import hashlib
import hmac
import http.server
import ipaddress
import re
import socket
import threading
import time
import urllib.parse
from typing import Any, ClassVar

from cycloid_fmu.edge.files import packaged_text

CONNECTIONS = 16  # at a time; each has a thread
REQUEST_SECONDS = 10.0  # for a whole request and its answer
_LOCAL = ("localhost", "127.0.0.1", "[::1]")


def is_loopback(host: str) -> bool:
    """Whether an address is local; a `ValueError` if it is not an address."""
    return ipaddress.ip_address(host).is_loopback


class PageServer(http.server.ThreadingHTTPServer):
    """A page and its data over HTTP; it serves from the beginning, and is a context manager that ends it.

    There are 16 connections at a time; one whose request is not answered after ten seconds is closed.

    Parameters
    ----------
    handler
        Class that handles the requests.
    host, port
        Address to listen on; port 0 takes a free one. On a local address only clients that use a local name are
        answered.
    token
        Token that a client must send; None for no token.

    Raises
    ------
    OSError
        If the address can't be listened on.
    """

    daemon_threads = True
    request_queue_size = 2 * CONNECTIONS  # a client beyond them is refused at once

    def __init__(self, handler: type[PageHandler], host: str, port: int, token: str | None) -> None:
        self._ends: dict[socket.socket, float] = {}
        self._counting = threading.Lock()
        self._stopping = threading.Event()
        self._serving: threading.Thread | None = None
        self.token, self.local = token, is_loopback(host)
        super().__init__((host, port), handler)
        self._serving = threading.Thread(target=self.serve_forever, args=(0.05,), name="page", daemon=True)
        self._serving.start()

    @property
    def url(self) -> str:
        """Address to open in the browser."""
        host, port = self.server_address[:2]
        query = "" if self.token is None else f"?token={self.token}"
        return f"http://{host if isinstance(host, str) else host.decode()}:{port}/{query}"

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a new thread, or close the connection if there are too many."""
        with self._counting:
            welcome = len(self._ends) < CONNECTIONS
            if welcome:
                self._ends[request] = time.monotonic() + REQUEST_SECONDS
        if welcome:
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def keep(self, request: socket.socket, seconds: float) -> None:
        """Set the time from now after which a connection is closed."""
        with self._counting:
            self._ends[request] = time.monotonic() + seconds

    def service_actions(self) -> None:
        """Close the connections whose time is over: the waiting calls of their threads then fail."""
        with self._counting:
            for request, end in self._ends.items():
                if time.monotonic() > end:
                    with contextlib.suppress(OSError):
                        request.shutdown(socket.SHUT_RDWR)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection and free its place."""
        with self._counting:
            self._ends.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print nothing about a disconnected client: the terminal belongs to the command."""

    def wait(self) -> None:
        """Wait until the server is closed."""
        self._stopping.wait()

    def server_close(self) -> None:
        """Stop serving and listening."""
        self._stopping.set()
        if self._serving is not None:  # None if listening failed
            self.shutdown()
        super().server_close()


@functools.cache
def _page(package: str) -> tuple[bytes, str]:
    """Return a package's page and the content policy that permits only its own script and style."""
    page = packaged_text(package, "page.html")
    own = {}
    for tag in ("script", "style"):
        (text,) = re.findall(f"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
        own[tag] = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    allowed = [f"{tag}-src 'sha256-{digest}'" for tag, digest in own.items()]
    none = [f"{what} 'none'" for what in ("default-src", "frame-ancestors", "base-uri", "form-action")]
    return page.encode(), "; ".join([*none, *allowed, "connect-src 'self'"])


class PageHandler(http.server.BaseHTTPRequestHandler):
    """Serves the page at `/`; other paths are served by `answer`."""

    server: PageServer
    timeout = REQUEST_SECONDS  # for a client that does not read
    package: ClassVar[str]
    """The package with `page.html`."""
    name: ClassVar[str]
    """The command, as the server's name."""

    def do_GET(self) -> None:
        """Answer with the page or its data."""
        path = self.welcome()
        if path == "/":
            self.send(_page(self.package)[0], "text/html; charset=utf-8")
        elif path is not None and not self.answer(path):
            self.send_error(404)

    def answer(self, path: str) -> bool:
        """Answer a path other than the page; False if there is nothing there."""
        return False

    def welcome(self) -> str | None:
        """Return the requested path; None if the client was refused."""
        try:
            parts = urllib.parse.urlsplit(self.path)
            query = urllib.parse.parse_qs(parts.query, max_num_fields=8)
        except ValueError:
            self.send_error(400)
            return None
        token = self.server.token
        known = token is None or hmac.compare_digest(query.get("token", [""])[0].encode(), token.encode())
        # DNS rebinding: a foreign page may resolve its own name to this machine, but the Host header shows that name.
        called = (self.headers.get("Host") or "").rsplit(":", 1)[0]
        if not known or (self.server.local and called not in _LOCAL):
            self.send_error(403)
            return None
        return parts.path

    def send(self, content: bytes, kind: str) -> None:
        """Send a complete answer; `kind` is its content type."""
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def end_headers(self) -> None:
        """Add the headers that forbid framing, caching, content sniffing and referrers."""
        self.send_header("Content-Security-Policy", _page(self.package)[1])
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("X-Frame-Options", "DENY")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Cache-Control", "no-store")
        super().end_headers()

    def version_string(self) -> str:
        """Return the server's name without Python's version."""
        return self.name

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing: the terminal belongs to the command."""
