"""The page's server: loopback alone, one secret address, no foreign page may ask.

Every path lies under a random token. A request is answered only if its Host is this server's own name (no other name may be
pointed here: DNS rebinding) and its Origin, where the browser sends one, is this page. What is malformed gets a status and one
sentence.
"""

from __future__ import annotations

import hmac
import json
import secrets
import sys
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

from pydantic import ValidationError

from avatar.play.config import Change
from avatar.play.session import Session

LOOPBACK = "127.0.0.1"
NAMES = (LOOPBACK, "localhost")
LARGEST_BYTES = {"state": 1 << 16, "camera": 8 << 20, "file": 64 << 20}
PATIENCE_S = 10.0
"""How long a page's question for the next picture is kept."""
CAMERA_PATIENCE_S = 0.5
HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "X-Frame-Options": "DENY",
}
POLICY = (
    "default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; img-src 'self' blob: data:; "
    "media-src blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)

Offer = Callable[[str, bytes], dict[str, Any]]
"""Takes in a file (name, content); ValueError with one sentence where it cannot be used."""


class Refused(Exception):
    """A request that is not answered: status and one sentence."""

    def __init__(self, status: int, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


class Server(ThreadingHTTPServer):
    """Listens on 127.0.0.1; `address` is what the user opens."""

    daemon_threads = True

    def __init__(self, session: Session, page: Callable[[str], str], offer: Offer, port: int = 0) -> None:
        """
        Args:
            page: the page's HTML, given the nonce of its scripts and styles; offer: takes in a parameter file.
            port: 0 takes a free one.

        Raises:
            OSError: the port is taken.
        """
        self.session, self.page, self.offer = session, page, offer
        self.token = secrets.token_urlsafe(16)
        super().__init__((LOOPBACK, port), Handler)

    @property
    def hosts(self) -> tuple[str, ...]:
        """What a request's Host may be."""
        return tuple(f"{name}:{self.server_port}" for name in NAMES)

    @property
    def address(self) -> str:
        """The page's address."""
        return f"http://{self.hosts[0]}/{self.token}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A page that was closed in the middle of an answer is no error."""
        if not isinstance(sys.exc_info()[1], ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


class Handler(BaseHTTPRequestHandler):
    """One connection."""

    server: Server
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "play", ""
    disable_nagle_algorithm = True
    wbufsize = -1  # head and body of an answer in one piece
    timeout = 60  # of a connection that says nothing

    def do_GET(self) -> None:
        """The page, the next picture, the state, the driver's preview."""
        self._answer({"": self._page, "picture": self._picture, "state": self._state, "driver": self._driver})

    def do_POST(self) -> None:
        """A change, a picture of the camera, a parameter file."""
        self._answer({"state": self._change, "camera": self._camera, "file": self._file})

    def _answer(self, known: dict[str, Callable[[dict[str, str]], None]]) -> None:
        try:
            name, query = self._admitted()
            if self.server.session.stopped:
                raise Refused(503, "the program has ended")
            if name not in known:
                raise Refused(404, "there is nothing here")
            known[name](query)
        except Refused as refused:
            self._refuse(refused.status, str(refused))
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            place = ".".join(str(part) for part in first["loc"]) or "message"
            self._refuse(400, f"{place}: {first['msg']}")
        except ValueError as error:
            self._refuse(400, str(error).splitlines()[0] if str(error) else "not understood")

    def _admitted(self) -> tuple[str, dict[str, str]]:
        """What is asked for and its query; Refused for a stranger."""
        if self.headers.get_all("Host") not in [[host] for host in self.server.hosts]:
            raise Refused(421, "this server answers under its own name only")
        origin = self.headers.get("Origin")
        if origin is not None and origin not in [f"http://{host}" for host in self.server.hosts]:
            raise Refused(403, "another page may not ask here")
        if self.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin"):
            raise Refused(403, "another page may not ask here")
        parts, secret = urlsplit(self.path), f"/{self.server.token}/"
        begun, name = parts.path[: len(secret)], parts.path[len(secret) :]
        if not hmac.compare_digest(begun.encode("utf-8", "replace"), secret.encode()):
            raise Refused(404, "there is nothing here")
        return name, {key: values[-1] for key, values in parse_qs(parts.query).items()}

    def _body(self, kind: str) -> bytes:
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit()):
            raise Refused(411, "the length of the message is missing")
        if int(length) > LARGEST_BYTES[kind]:
            raise Refused(413, f"at most {LARGEST_BYTES[kind] >> 10} kB are taken here")
        data = self.rfile.read(int(length))
        if len(data) < int(length):
            raise Refused(400, "the message ends too early")
        return data

    def _send(self, status: int, kind: str, data: bytes, more: dict[str, str] | None = None) -> None:
        self.send_response(status)
        for name, value in {**HEADERS, "Content-Type": kind, "Content-Length": str(len(data)), **(more or {})}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(data)
        self.wfile.flush()

    def _json(self, content: dict[str, Any], status: int = 200, more: dict[str, str] | None = None) -> None:
        self._send(status, "application/json", json.dumps(content, allow_nan=False).encode(), more)

    def _refuse(self, status: int, sentence: str) -> None:
        self.close_connection = True  # what is left of the message would be read as the next one
        self._json({"error": sentence}, status, {"Connection": "close"})

    def _page(self, query: dict[str, str]) -> None:
        nonce = secrets.token_urlsafe(16)
        policy = {"Content-Security-Policy": POLICY.format(nonce=nonce), "Permissions-Policy": "camera=(self), microphone=()"}
        self._send(200, "text/html; charset=utf-8", self.server.page(nonce).encode(), policy)

    def _picture(self, query: dict[str, str]) -> None:
        after = query.get("after", "0")
        if not (after.isascii() and after.isdigit() and len(after) < 16):
            raise ValueError("after: a number of a picture is expected")
        shown = self.server.session.picture(int(after), PATIENCE_S)
        if shown is None:
            self._send(204, "image/jpeg", b"")
            return
        facts = json.dumps({"number": shown.number} | shown.facts)
        self._send(200, "image/jpeg", shown.jpeg, {"X-Play": facts})

    def _state(self, query: dict[str, str]) -> None:
        self._json(self.server.session.state())

    def _driver(self, query: dict[str, str]) -> None:
        preview = self.server.session.preview()
        self._send(204 if preview is None else 200, "image/jpeg", preview or b"")

    def _change(self, query: dict[str, str]) -> None:
        version = self.server.session.change(Change.model_validate_json(self._body("state")))
        self._json({"version": version})

    def _camera(self, query: dict[str, str]) -> None:
        data = self._body("camera")
        if data[:2] != b"\xff\xd8":
            raise ValueError("a picture of the camera must be a JPEG")
        self._json({"taken": self.server.session.film(data, "camera", CAMERA_PATIENCE_S)})

    def _file(self, query: dict[str, str]) -> None:
        self._json(self.server.offer(query.get("name", "parameters.csv"), self._body("file")))

    def log_message(self, format: str, *arguments: Any) -> None:
        """Nothing is written for a request: there are thirty a second."""
