"""Server on 127.0.0.1 for the browser of one user.

    with Server({"GET /": page, "GET /rows": rows, "POST /set": change}) as server:
        open_page("live view", server.url)

Every address begins with a random token, http://127.0.0.1:PORT/TOKEN/…; anything else is not found. There is no cookie,
because browsers send a cookie to every port of a host, also to the server of another user. `Host` must name this
server, so that no other name can be bound to its address, and `Origin`, if any, must be this server. No other origin is
allowed to read answers (CORS). A connection serves one request, which must arrive within `REQUEST_TIME`.
"""

from __future__ import annotations

import errno
import io
import os
import secrets
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Self
from urllib.parse import parse_qsl, unquote, urlsplit

from cosim.base.errors import CosimError, InputError
from cosim.server.answers import Answer, Handler, Request, byte_range, json_answer, json_text
from cosim.storage.files import parse_json

PORT_REFUSED = "port {port} cannot be used: {reason}; give another one, or 0 for any free port"

ADDRESS = "127.0.0.1"
REQUEST_TIME = 10.0  # [s] until the whole request has arrived
SENDING_TIME = 10.0  # [s] without progress while an answer is sent
MOST_CONNECTIONS = 64
MOST_BODY = 1 << 16  # [bytes]
BLOCK = 1 << 18  # bytes of a file sent at a time
ALIVE = 1.0  # [s] between signs of life in a stream of events
SAFE = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}


class Server:
    """A local server; a context manager that listens from its creation to its end.

    Args:
        routes: Method and path, e.g. `GET /rows`, to handler. A path that ends with a slash, other than `/`, takes all
            paths below.
        port: 0 for any free port.
        option: Source of the port, for messages.

    Raises:
        InputError: The port cannot be used.
    """

    def __init__(self, routes: Mapping[str, Handler], port: int = 0, *, option: str = "--port") -> None:
        self.routes, self.token = dict(routes), secrets.token_urlsafe(32)
        try:
            self._listener = _Listener((ADDRESS, port), self)
        except OSError as error:
            is_used = error.errno == errno.EADDRINUSE
            message = (
                f"port {port} is in use by another program; give another one, or 0 for any free port"
                if is_used
                else _refused(port, error)
            )
            raise InputError.at(Path(option), message) from None
        except OverflowError:
            message = PORT_REFUSED.format(port=port, reason="ports are numbers from 1 to 65535")
            raise InputError.at(Path(option), message) from None
        self.port: int = self._listener.server_address[1]
        self.closing = threading.Event()
        self.streams = 0  # open streams of events, i.e. pages
        self.opened = False  # whether a page has ever been open
        self._thread = threading.Thread(target=self._listener.serve_forever, args=(0.05,), daemon=True)
        self._thread.start()

    @property
    def origin(self) -> str:
        """Return the origin of all pages."""
        return f"http://{ADDRESS}:{self.port}"

    @property
    def url(self) -> str:
        """Return the address of the first page, with the token."""
        return f"{self.origin}/{self.token}/"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End all streams and connections; repeated calls are harmless."""
        if self.closing.is_set():
            return
        self.closing.set()
        self._listener.shutdown()
        self._listener.server_close()
        self._listener.end_connections()
        self._thread.join()

    # -- requests, from any thread ------------------------------------------------------------------

    def find(self, method: str, path: str) -> tuple[Handler | None, str]:
        """Return the handler of a path behind the token, and the path, or its rest behind a route with all below."""
        if (handler := self.routes.get(f"{method} /{path}")) is not None:
            return handler, path
        for route, handler in self.routes.items():
            kind, _, begin = route.partition(" /")
            if begin.endswith("/") and kind == method and path.startswith(begin):
                return handler, path[len(begin) :]
        return None, path

    def has_path(self, path: str) -> bool:
        """Return whether a path has a handler for any method."""
        methods = {route.partition(" ")[0] for route in self.routes}
        return any(self.find(method, path)[0] is not None for method in methods)

    @contextmanager
    def stream(self) -> Iterator[None]:
        """Count an open stream."""
        with self._listener.lock:
            self.streams, self.opened = self.streams + 1, True
        try:
            yield
        finally:
            with self._listener.lock:
                self.streams -= 1


def _refused(port: int, error: OSError) -> str:
    return PORT_REFUSED.format(port=port, reason=(error.strerror or str(error)).lower())


class _Listener(ThreadingHTTPServer):
    """The listening socket, with a thread for each connection up to a limit."""

    daemon_threads = True
    block_on_close = False
    allow_reuse_address = os.name == "posix"  # On Windows another program could then listen on the same port.
    request_queue_size = 64

    def __init__(self, address: tuple[str, int], owner: Server) -> None:
        self.owner, self.lock = owner, threading.Lock()
        self.connections = dict[Any, bool]()  # in order of time, and whether each has sent the token
        super().__init__(address, _Connection)

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Return whether there is room for a connection; end the oldest one that has not sent the token, if need be."""
        with self.lock:
            if len(self.connections) >= MOST_CONNECTIONS:
                stranger = next((each for each, has_token in self.connections.items() if not has_token), None)
                if stranger is None:
                    return False
                del self.connections[stranger]
                with suppress(OSError):
                    stranger.shutdown(socket.SHUT_RDWR)
            self.connections[request] = False
        return True

    def keep(self, request: Any) -> None:
        """Note that a connection has sent the token."""
        with self.lock:
            if request in self.connections:
                self.connections[request] = True

    def shutdown_request(self, request: Any) -> None:
        """End a connection."""
        with self.lock:
            self.connections.pop(request, None)
        super().shutdown_request(request)

    def end_connections(self) -> None:
        """End all connections, so that their threads end."""
        with self.lock:
            connections = [*self.connections]
        for connection in connections:
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore connections that break."""


class _Incoming(io.RawIOBase):
    """Bytes of a connection until a deadline; a client that sends slowly gains no time."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection, self._deadline = connection, time.monotonic() + REQUEST_TIME

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        self._connection.settimeout(max(1e-3, self._deadline - time.monotonic()))
        return self._connection.recv_into(buffer)


class _Refused(Exception):
    """A request that gets an error, with its status and reason."""

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(reason)
        self.status, self.reason = status, reason


class _Connection(BaseHTTPRequestHandler):
    """One connection with one request."""

    protocol_version = "HTTP/1.1"
    server: _Listener

    def setup(self) -> None:
        """Prepare the streams of the connection."""
        super().setup()
        self.rfile = io.BufferedReader(_Incoming(self.connection))

    def version_string(self) -> str:
        """Return the name of the server, without versions."""
        return "cosim"

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing: addresses contain the token."""

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer a request that is no HTTP."""
        self._send(json_answer({"error": message or "bad request"}, int(code)))

    def do_GET(self) -> None:
        """Answer a request for content."""
        self._answer("GET")

    def do_HEAD(self) -> None:
        """Answer a request for headers."""
        self._answer("GET")

    def do_POST(self) -> None:
        """Answer a request for a change."""
        self._answer("POST")

    def _answer(self, method: str) -> None:
        try:
            answer = self._handle(method)
        except _Refused as refusal:
            answer = json_answer({"error": refusal.reason}, refusal.status)
        except CosimError as error:
            answer = json_answer({"error": str(error), "kind": type(error).__name__}, 400)
        except TimeoutError:
            raise
        except Exception as error:  # A fault of a handler must not end the program of the user.
            answer = json_answer({"error": f"{type(error).__name__}: {error}"}, 500)
        self._send(answer)

    def _handle(self, method: str) -> Answer:
        """Return the answer of a handler; raise _Refused before any handler sees a request that must not be."""
        owner = self.server.owner
        self._check_source()
        parts = urlsplit(self.path)
        token, slash, path = parts.path.removeprefix("/").partition("/")
        if not secrets.compare_digest(token.encode(), owner.token.encode()):
            raise _Refused(404, "not found")
        self.server.keep(self.request)
        if not slash:  # Addresses in pages are relative.
            return Answer(status=308, headers={"Location": f"/{owner.token}/"})
        handler, rest = owner.find(method, unquote(path))
        if handler is None:
            if owner.has_path(unquote(path)):
                raise _Refused(405, "method not allowed")
            raise _Refused(404, "not found")
        content = self._content() if method == "POST" else None
        return handler(Request(rest, dict(parse_qsl(parts.query, True)), content, owner.closing.wait))

    def _check_source(self) -> None:
        """Raise _Refused for a request from another site, or under another name of this address."""
        origin = self.server.owner.origin
        if self.headers.get_all("Host", []) != [origin.removeprefix("http://")]:
            raise _Refused(403, "wrong host")
        if any(other != origin for other in self.headers.get_all("Origin", [])):
            raise _Refused(403, "wrong origin")
        site, mode = (self.headers.get(f"Sec-Fetch-{name}") for name in ("Site", "Mode"))
        if site not in {None, "same-origin", "none"} and mode != "navigate":
            raise _Refused(403, "wrong origin")

    def _content(self) -> Any:
        """Return the JSON of the body."""
        kind = self.headers.get_content_type()
        if kind != "application/json":
            raise _Refused(415, "the content is application/json")
        lengths = self.headers.get_all("Content-Length", [])
        if self.headers.get("Transfer-Encoding") or len(lengths) != 1 or not lengths[0].strip().isdecimal():
            raise _Refused(411, "Content-Length is missing")
        if (length := int(lengths[0])) > MOST_BODY:
            self.rfile.read(min(length, 16 * MOST_BODY))  # Closing with unread bytes would destroy the answer.
            raise _Refused(413, f"the content is longer than {MOST_BODY} bytes")
        try:
            return parse_json(self.rfile.read(length))
        except (ValueError, RecursionError):
            raise _Refused(400, "the content is no JSON") from None

    # -- answers --------------------------------------------------------------------------------

    def _send(self, answer: Answer) -> None:
        self.connection.settimeout(SENDING_TIME)
        if answer.events is not None:
            self._send_events(answer.events)
        elif answer.file is not None:
            try:
                self._send_file(answer, answer.file)
            finally:
                if answer.is_temporary:
                    answer.file.unlink(missing_ok=True)
        else:
            self._send_head(answer.status, answer.kind, {**answer.headers, "Content-Length": str(len(answer.body))})
            if self.command != "HEAD":
                self.wfile.write(answer.body)

    def _send_head(self, status: int, kind: str, headers: Mapping[str, str]) -> None:
        policy = {"Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'"}
        self.send_response(status)
        for name, value in {**SAFE, **policy, "Content-Type": kind, **headers, "Connection": "close"}.items():
            self.send_header(name, value)
        self.end_headers()

    def _send_file(self, answer: Answer, file: Path) -> None:
        """Send a file, or the part that the request asks for."""
        try:
            stream = file.open("rb")
        except OSError:
            self._send(json_answer({"error": "not found"}, 404))
            return
        with stream:
            about = os.fstat(stream.fileno())
            size, tag = about.st_size, f'"{about.st_mtime_ns:x}-{about.st_size:x}"'
            headers = {**answer.headers, "Accept-Ranges": "bytes", "ETag": tag}
            asked = self.headers.get("Range", "") if self.headers.get("If-Range", tag) == tag else ""
            try:
                part = byte_range(asked, size)
            except ValueError:
                self._send(Answer(status=416, kind=answer.kind, headers={"Content-Range": f"bytes */{size}"}))
                return
            begin, end = part or (0, size)
            if part is not None:
                headers["Content-Range"] = f"bytes {begin}-{end - 1}/{size}"
            headers["Content-Length"] = str(end - begin)
            self._send_head(200 if part is None else 206, answer.kind, headers)
            stream.seek(begin)
            while self.command != "HEAD" and begin < end:
                block = stream.read(min(BLOCK, end - begin))
                if not block:  # The file has become shorter.
                    break
                self.wfile.write(block)
                begin += len(block)

    def _send_events(self, events: Iterator[Any]) -> None:
        """Send events until their end, the end of the server, or the end of the page."""
        self._send_head(200, "text/event-stream", {})
        if self.command == "HEAD":
            return
        alive = time.monotonic()
        with self.server.owner.stream():
            for content in events:
                now = time.monotonic()
                if content is not None:
                    self.wfile.write(f"data: {json_text(content)}\n\n".encode())
                elif now - alive >= ALIVE:
                    self.wfile.write(b":\n\n")  # fails if the page is gone
                else:
                    continue
                alive = now
