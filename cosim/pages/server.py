"""Server on 127.0.0.1 for the browser of one user; other users and other sites can neither read nor control it.

Every address begins with a random token, http://127.0.0.1:PORT/TOKEN/…; other addresses are not found. There is no
cookie, because browsers send a cookie to every port of a host, also to the server of another user. `Host` must name
this server, so that no other name can be bound to its address, and `Origin`, if any, must be this server. No other
origin may read responses (CORS).
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import html as html_text
import json
import os
import re
import secrets
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import AsyncIterator, Callable, Mapping
from pathlib import Path
from typing import Any, Protocol, Self

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from cosim.core.errors import CosimError, InputError
from cosim.core.messages import Note, printable_json
from cosim.core.scratch import process_folder
from cosim.files.files import parse_json

ADDRESS = "127.0.0.1"
MAX_BODY = 1 << 16  # [bytes]
MAX_HTTP_CONNECTIONS = 64
TICK = 0.1  # [s] between two updates of a page
ALIVE = 1.0  # [s] between keep-alive messages in the stream of states
FIRST_PAGE = 20.0  # [s] within which a page must be opened
RELOAD = 2.0  # [s] without a page, as during a reload, after which the server ends
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
DENY_ALL_POLICY = "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
SANDBOX = "sandbox allow-scripts allow-downloads allow-modals"  # a page in an origin of its own
SAFE = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Content-Security-Policy": DENY_ALL_POLICY,
}
OPENING = (
    '<!DOCTYPE html><meta charset="utf-8"><meta http-equiv="refresh" content="0; url={url}"><title>{title}</title>'
)
Handler = Callable[[Request, Any], Response]  # request and its decoded JSON


class Json(JSONResponse):
    """JSON response in which control characters are escaped, so that a page can show all texts."""

    def render(self, content: Any) -> bytes:
        """Return the body."""
        return printable_json(json.dumps(content)).encode()


def html_response(page: str, *, alone: bool = False) -> Response:
    """Return a page that can run and show only its own inline scripts and styles.

    Args:
        alone: Give the page an origin of its own, so that its scripts (e.g. of a report) cannot reach the server.
    """
    allowed = []
    for kind in ("script", "style"):
        texts = re.findall(rf"<{kind}>(.*?)</{kind}>", page, re.DOTALL)
        digests = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in texts)
        allowed.append(" ".join(f"'sha256-{digest}'" for digest in digests) or "'none'")
    parts = [DENY_ALL_POLICY, f"script-src {allowed[0]}", f"style-src-elem {allowed[1]}"]
    parts += ["style-src-attr 'unsafe-inline'", "img-src data: blob:"]  # Charts position their ticks by attributes.
    policy = "; ".join([*parts, SANDBOX if alone else "connect-src 'self'"])
    return Response(page, media_type="text/html", headers={"Content-Security-Policy": policy})


class Part(Protocol):
    """A part of a page that has its own routes and its own state."""

    def routes(self) -> Mapping[str, Handler]:
        """Return method and path, e.g. `GET /rows` → handler."""

    def state(self) -> dict[str, Any]:
        """Return the complete state as JSON data."""


class ServedPage:
    """A served page; each change of its state is sent to the browser. A context manager, served from its creation.

    Subclasses add routes and parts of the state. Any thread may read and write the state.

    Args:
        page: HTML of the page.
        port: 0 for any free port.
        part: Part of the page.
        state: Initial state.

    Attributes:
        streams: Number of browser pages that are open.
        opened: True if a page has ever been open.

    Raises:
        InputError: The port cannot be used.
    """

    def __init__(self, page: str, port: int = 0, part: Part | None = None, **state: Any) -> None:
        self._lock, self._part = threading.RLock(), part
        self._state: dict[str, Any] = state
        self._version = 0
        self.streams, self.opened = 0, False
        self.token = secrets.token_urlsafe(32)
        self._socket = _listen(port)
        self.port: int = self._socket.getsockname()[1]
        routes = {"GET /": lambda request, _: html_response(page), **self.routes()}
        found = [Route(route.split()[1], _endpoint(h), methods=[route.split()[0]]) for route, h in routes.items()]
        failures: Any = {HTTPException: _refused, CosimError: _refused, OSError: _refused, Exception: _refused}
        events = Route("/events", lambda _: StreamingResponse(self._states(), media_type="text/event-stream"))
        app = Starlette(routes=[events, *found], exception_handlers=failures)
        settings = uvicorn.Config(
            _Guard(app, self),
            log_level="critical",
            lifespan="off",
            access_log=False,
            server_header=False,
            limit_concurrency=MAX_HTTP_CONNECTIONS,
            timeout_graceful_shutdown=0,
        )
        self._server = uvicorn.Server(settings)
        self._thread = threading.Thread(target=self._server.run, args=([self._socket],), daemon=True)
        self._thread.start()

    @property
    def origin(self) -> str:
        """Return the origin of all pages."""
        return f"http://{ADDRESS}:{self.port}"

    @property
    def url(self) -> str:
        """Return the address of the page, with the token."""
        return f"{self.origin}/{self.token}/"

    def routes(self) -> Mapping[str, Handler]:
        """Return the routes of a subclass: method and path, e.g. `GET /rows` → handler."""
        return {} if self._part is None else self._part.routes()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def close(self) -> None:
        """Close all streams and connections; repeated calls have no effect."""
        self._server.should_exit = self._server.force_exit = True
        self._thread.join()
        self._socket.close()

    # -- state ---------------------------------------------------------------------------------------

    def update(self, **state: Any) -> None:
        """Change parts of the state; the page shows them within `TICK` seconds."""
        with self._lock:
            self._state |= state
            self._version += 1

    def state(self) -> dict[str, Any]:
        """Return the complete state as JSON data."""
        with self._lock:
            state = {**self._state}
        return state if self._part is None else {**state, **self._part.state()}

    async def _states(self) -> AsyncIterator[str]:
        last, sent = None, 0.0
        self.streams, self.opened = self.streams + 1, True
        try:
            while not self._server.should_exit:
                part = {} if self._part is None else await run_in_threadpool(self._part.state)
                if (version := (self._version, part)) != last:
                    last, sent = version, time.monotonic()
                    yield f"data: {printable_json(json.dumps(await run_in_threadpool(self.state)))}\n\n"
                elif time.monotonic() - sent > ALIVE:
                    sent = time.monotonic()
                    yield ":\n\n"  # fails if the page is closed
                await asyncio.sleep(TICK)
        finally:
            self.streams -= 1

    def wait_for_close(self, say: Callable[[str], None], first: float = FIRST_PAGE, reload: float = RELOAD) -> None:
        """Serve until the user closes the last page, or none opens in time.

        Args:
            first: Longest time until the first page [s].
        """
        since = time.monotonic()
        try:
            if self.streams or (first and not self.opened):
                say(Note("the command ends when the page is closed in the browser, or with Ctrl-C"))
            while self.streams or time.monotonic() - since < (reload if self.opened else first):
                if self.streams:  # After a page was closed, a reload has its full time.
                    since = time.monotonic()
                time.sleep(TICK)
        finally:
            self.close()


class _Guard:
    """Check of each request: host, origin and token (which is removed from the path); adds headers to each response."""

    def __init__(self, app: ASGIApp, page: ServedPage) -> None:
        self._app, self._page = app, page

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_safely(message: Message) -> None:
            if message["type"] == "http.response.start":
                present = {name for name, _ in message["headers"]}
                safe = {name.lower().encode(): value.encode() for name, value in SAFE.items()}
                message["headers"] += [(name, value) for name, value in safe.items() if name not in present]
            await send(message)

        page, values = self._page, [(name.decode("latin-1"), v.decode("latin-1")) for name, v in scope["headers"]]
        token, slash, path = scope["path"].removeprefix("/").partition("/")
        origins, headers = [v for name, v in values if name == "origin"], dict(values)
        is_foreign = headers.get("sec-fetch-site") not in {None, "same-origin", "none"}
        if [v for name, v in values if name == "host"] != [page.origin.removeprefix("http://")]:
            answer: ASGIApp = Json({"error": "wrong host"}, 403)
        elif set(origins) - {page.origin} or (is_foreign and headers.get("sec-fetch-mode") != "navigate"):
            answer = Json({"error": "wrong origin"}, 403)
        elif not secrets.compare_digest(token.encode(), page.token.encode()):
            answer = Json({"error": "not found"}, 404)
        elif not slash:  # Addresses in pages are relative.
            answer = RedirectResponse(f"/{page.token}/", 308)
        else:
            scope, answer = {**scope, "path": f"/{path}"}, self._app
        await answer(scope, receive, send_safely)


def _endpoint(handler: Handler) -> Callable[[Request], Any]:
    async def answer(request: Request) -> Response:
        content = None
        if request.method == "POST":
            if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
                raise HTTPException(415, "the content type must be application/json")
            if not request.headers.get("content-length", "").isdecimal():
                raise HTTPException(411, "Content-Length is missing")
            if int(request.headers["content-length"]) > MAX_BODY:
                raise HTTPException(413, f"the content is longer than {MAX_BODY} bytes")
            try:
                content = parse_json(await request.body())
            except (ValueError, RecursionError):
                raise HTTPException(400, "the content is not JSON") from None
        return await run_in_threadpool(handler, request, content)

    return answer


def _refused(request: Request, error: Exception) -> Response:
    """Return the response to a failed request; a fault of a handler must not end the user's program."""
    if isinstance(error, HTTPException):
        return Json({"error": str(error.detail).lower()}, error.status_code)
    if isinstance(error, CosimError):
        return Json({"error": str(error), "kind": type(error).__name__}, 400)
    return Json({"error": f"{type(error).__name__}: {error}"}, 500)


def _listen(port: int) -> socket.socket:
    """Return a socket that listens on a port."""
    made = socket.socket()
    if os.name == "posix":  # On Windows another program could then listen on the same port.
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        made.bind((ADDRESS, port))
        made.listen(MAX_HTTP_CONNECTIONS)
    except (OSError, OverflowError) as error:
        made.close()
        reason = error.strerror if isinstance(error, OSError) else "allowed are ports from 1 to 65535"
        message = f"port {port} cannot be used: {reason}; give another one, or 0 for any free port"
        raise InputError.at(Path("--port"), message) from None
    return made


# -- the user's browser ---------------------------------------------------------------------------


def open_page(url: str, title: str) -> bool:
    """Open an address in the browser; return True if a browser was started.

    The browser gets a file that only this user can read and that redirects to the address. The command line of a
    browser, which all users can read, then has no token.
    """
    if not (os.name == "nt" or sys.platform == "darwin" or any(os.environ.get(name) for name in DISPLAYS)):
        return False
    page = process_folder() / "open.html"
    page.touch(0o600)
    page.write_text(OPENING.format(url=html_text.escape(url), title=html_text.escape(title)), encoding="utf-8")
    return webbrowser.open(page.resolve().as_uri())
