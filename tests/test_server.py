"""The local server answers pages of its own user alone: token, host, origin, paths, bodies, ranges, slow clients."""

from __future__ import annotations

import http.client
import json
import os
import re
import socket
import stat
import threading
import time
import webbrowser
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from cosim.base.errors import InputError
from cosim.server import local_server
from cosim.server.answers import Answer, Request, json_answer, page_answer
from cosim.server.browser import has_display, open_page
from cosim.server.local_server import MOST_BODY, MOST_CONNECTIONS, Server

CONTENT = bytes(range(256)) * 4
PAGE = "<!DOCTYPE html><style>p { color: red }</style><p style='left: 1px'>x</p><script>go()</script>"


@dataclass
class Served:
    """A server and what its handlers have received."""

    server: Server
    received: list[Any] = field(default_factory=list)

    def ask(
        self, path: str, method: str = "GET", *, token: str | None = None, body: Any = None, **headers: str
    ) -> tuple[int, dict[str, str], bytes]:
        """Status, headers and body of an answer; `path` is behind the token."""
        connection = http.client.HTTPConnection("127.0.0.1", self.server.port, timeout=10)
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        if body is not None and "Content-Type" not in named:
            named["Content-Type"] = "application/json"
        connection.request(method, f"/{self.server.token if token is None else token}{path}", body, named)
        answer = connection.getresponse()
        got = answer.status, dict(answer.getheaders()), answer.read()
        connection.close()
        return got

    def raw(self, text: bytes) -> bytes:
        """The answer to bytes as they are."""
        with socket.create_connection(("127.0.0.1", self.server.port), timeout=10) as connection:
            connection.sendall(text)
            connection.shutdown(socket.SHUT_WR)
            return b"".join(iter(lambda: connection.recv(65536), b""))


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    file = tmp_path / "rows.bin"
    file.write_bytes(CONTENT)
    received: list[Any] = []

    def change(request: Request) -> Answer:
        received.append(request.content)
        return json_answer({"ok": True})

    def events(request: Request) -> Answer:
        def numbers() -> Iterator[Any]:
            yield {"n": 0}
            while not request.is_closing(0.02):
                yield None

        return Answer(events=numbers())

    def crash(request: Request) -> Answer:
        raise KeyError("gone")

    def refuse(request: Request) -> Answer:
        raise InputError.at(Path("--set"), "no such thing")

    routes = {
        "GET /": lambda request: page_answer(PAGE),
        "GET /rows": lambda request: json_answer({"query": dict(request.query)}),
        "GET /files/": lambda request: Answer(file=file) if request.path == "a b" else json_answer({}, 404),
        "GET /gone": lambda request: Answer(file=tmp_path / "none"),
        "GET /events": events,
        "GET /crash": crash,
        "GET /refuse": refuse,
        "POST /set": change,
    }
    with Server(routes) as server:
        yield Served(server, received)


def test_the_server_listens_on_the_loopback_address_alone_under_a_long_random_token(served: Served) -> None:
    assert served.server.url == f"http://127.0.0.1:{served.server.port}/{served.server.token}/"
    assert len(served.server.token) >= 40
    with Server({}) as other:
        assert other.token != served.server.token
        assert other.port != served.server.port
    assert served.server._listener.server_address[0] == "127.0.0.1"


def test_an_answer_is_never_stored_framed_or_shared_with_another_origin(served: Served) -> None:
    status, headers, body = served.ask("/rows?a=1&b=x%20y&a=2")
    assert (status, json.loads(body)) == (200, {"query": {"a": "2", "b": "x y"}})
    assert headers["Cache-Control"] == "no-store"
    assert headers["X-Frame-Options"] == "DENY"
    assert headers["Referrer-Policy"] == "no-referrer"
    assert headers["Server"] == "cosim"
    assert not [name for name in headers if name.lower().startswith("access-control") or name == "Set-Cookie"]
    status, headers, _ = served.ask("/rows", "OPTIONS", Origin="https://evil.example")
    assert status in {403, 501}
    assert not [name for name in headers if name.lower().startswith("access-control")]


@pytest.mark.parametrize("token", ["", "x", "a" * 43, "%C3%BC", "%00", "..", "."])
def test_a_wrong_token_finds_nothing_and_changes_nothing(served: Served, token: str) -> None:
    for path, method in (("/", "GET"), ("/rows", "GET"), ("/none", "GET"), ("/set", "POST")):
        status, _, body = served.ask(path, method, token=token, body="1" if method == "POST" else None)
        assert (status, json.loads(body)) == (404, {"error": "not found"})
    assert served.received == []


def test_a_right_token_with_more_or_less_is_wrong(served: Served) -> None:
    token = served.server.token
    for wrong in (token[:-1], token + "x", token.swapcase(), f"{token}/{token}"):
        assert served.ask("/rows", token=wrong)[0] == 404
    status, headers, _ = served.ask("")
    assert (status, headers["Location"]) == (308, f"/{token}/")
    raw = served.raw("GET /\u00fc/ HTTP/1.1\r\nHost: ".encode() + served.server.origin[7:].encode() + b"\r\n\r\n")
    assert raw.startswith(b"HTTP/1.1 404 ")


@pytest.mark.parametrize(
    "hosts",
    [(), ("evil.example",), ("localhost:{port}",), ("127.0.0.1",), ("127.0.0.1:1",), ("127.0.0.1:{port}", "evil")],
)
def test_a_foreign_or_missing_or_repeated_host_is_refused(served: Served, hosts: tuple[str, ...]) -> None:
    lines = "".join(f"Host: {host.format(port=served.server.port)}\r\n" for host in hosts)
    for method, path in (("GET", "rows"), ("POST", "set")):
        more = "Content-Type: application/json\r\nContent-Length: 1\r\n"
        answer = served.raw(f"{method} /{served.server.token}/{path} HTTP/1.1\r\n{lines}{more}\r\n1".encode())
        assert answer.startswith(b"HTTP/1.1 403 ")
    assert served.received == []


@pytest.mark.parametrize("origin", ["https://evil.example", "null", "http://127.0.0.1:1", "http://localhost:{port}"])
def test_a_foreign_origin_can_neither_read_nor_change(served: Served, origin: str) -> None:
    origin = origin.format(port=served.server.port)
    assert served.ask("/rows", Origin=origin)[0] == 403
    assert served.ask("/set", "POST", body="1", Origin=origin)[0] == 403
    assert served.ask("/set", "POST", body="1", Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="no-cors")[0] == 403
    assert served.ask("/rows", Sec_Fetch_Site="same-site", Sec_Fetch_Mode="cors")[0] == 403
    assert served.received == []
    assert served.ask("/", Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="navigate")[0] == 200  # from the file that leads
    assert served.ask("/set", "POST", body="1", Origin=served.server.origin)[0] == 200
    assert served.received == [1]


@pytest.mark.parametrize(
    "path",
    [
        "/files/../../etc/passwd", "/files/%2e%2e/%2e%2e/etc/passwd", "/files/..%2f..%2fetc%2fpasswd",
        "/files//etc/passwd", "/files/a%20b/", "/files/a%20b%00", "/../rows", "/files/", "/ROWS",
    ],
)  # fmt: skip
def test_no_path_leads_out_of_what_is_offered(served: Served, path: str) -> None:
    assert served.ask(path)[0] == 404
    assert served.ask("/files/a%20b")[2] == CONTENT


def test_methods_bodies_and_faults_have_their_statuses(served: Served) -> None:
    assert served.ask("/set")[0] == served.ask("/rows", "POST", body="1")[0] == 405
    assert served.ask("/rows", "DELETE")[0] == 501
    assert served.ask("/set", "POST", body="a=1", Content_Type="application/x-www-form-urlencoded")[0] == 415
    assert served.ask("/set", "POST", body="a=1", Content_Type="text/plain")[0] == 415
    assert served.ask("/set", "POST", body="{")[0] == 400
    assert served.ask("/set", "POST", body="[" * 50_000)[0] == 400
    assert served.ask("/set", "POST", body=b" " * MOST_BODY + b"1")[0] == 413
    assert served.ask("/set", "POST", body="1", Transfer_Encoding="chunked")[0] in {400, 411}
    assert served.ask("/crash")[0] == 500
    status, _, body = served.ask("/refuse")
    assert (status, json.loads(body)["error"]) == (400, "--set: no such thing")
    assert served.received == []
    head = f"POST /{served.server.token}/set HTTP/1.1\r\nHost: 127.0.0.1:{served.server.port}\r\n"
    for lines in ("", "Content-Length: -1\r\n", "Content-Length: x\r\n", "Content-Length: 1\r\nContent-Length: 1\r\n"):
        answer = served.raw(f"{head}Content-Type: application/json\r\n{lines}\r\n1".encode())
        assert answer.startswith(b"HTTP/1.1 411 ")
    for text in (b"\x00\x01\r\n\r\n", b"GET\r\n\r\n", b"GET / HTTP/9.9\r\n\r\n", b"A" * 70_000, b""):
        assert served.server.token.encode() not in served.raw(text)
    assert served.ask("/rows")[0] == 200


def test_a_page_runs_its_own_scripts_alone(served: Served) -> None:
    status, headers, body = served.ask("/")
    policy = headers["Content-Security-Policy"]
    assert (status, body.decode()) == (200, PAGE)
    assert "default-src 'none'" in policy
    assert re.search(r"script-src 'sha256-[\w+/]+='(;|$)", policy)
    assert "connect-src 'self'" in policy
    assert "sandbox" not in policy
    alone = page_answer(PAGE, alone=True).headers["Content-Security-Policy"]
    assert "connect-src" not in alone
    assert "sandbox allow-scripts" in alone


@pytest.mark.parametrize(
    ("asked", "status", "begin", "end"),
    [
        ("bytes=0-9", 206, 0, 10), ("bytes=1000-", 206, 1000, 1024), ("bytes=-4", 206, 1020, 1024),
        ("bytes=1020-9999", 206, 1020, 1024), ("bytes=-9999", 206, 0, 1024), ("bytes=0-1,4-5", 200, 0, 1024),
        ("rows=0-9", 200, 0, 1024), ("bytes=9-2", 200, 0, 1024), ("bytes=-", 200, 0, 1024),
    ],
)  # fmt: skip
def test_a_file_is_sent_whole_or_in_the_range_asked_for(
    served: Served, asked: str, status: int, begin: int, end: int
) -> None:
    got, headers, body = served.ask("/files/a%20b", Range=asked)
    assert (got, body) == (status, CONTENT[begin:end])
    assert headers.get("Content-Range") == (f"bytes {begin}-{end - 1}/1024" if status == 206 else None)
    assert headers["Accept-Ranges"] == "bytes"


def test_a_range_beyond_the_file_or_of_another_version_is_not_sent(served: Served) -> None:
    status, headers, body = served.ask("/files/a%20b", Range="bytes=1024-")
    assert (status, headers["Content-Range"], body) == (416, "bytes */1024", b"")
    assert served.ask("/files/a%20b", Range="bytes=-0")[0] == 416
    tag = served.ask("/files/a%20b", "HEAD")[1]["ETag"]
    assert served.ask("/files/a%20b", Range="bytes=0-9", If_Range=tag)[0] == 206
    assert served.ask("/files/a%20b", Range="bytes=0-9", If_Range='"old"')[0] == 200
    assert served.ask("/files/a%20b", "HEAD")[2] == b""
    assert served.ask("/gone")[0] == 404


def test_slow_clients_hold_up_nobody_and_are_dropped(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local_server, "REQUEST_TIME", 0.4)
    slow = [socket.create_connection(("127.0.0.1", served.server.port), timeout=10) for _ in range(5)]
    slow[0].sendall(b"GET /")
    assert served.ask("/rows")[0] == 200
    for _ in range(8):  # a byte now and then gains no time
        time.sleep(0.1)
        try:
            slow[0].sendall(b"x")
        except OSError:
            break
    for connection in slow:
        connection.settimeout(5)
        with suppress(ConnectionError):
            assert connection.recv(1) == b""
        connection.close()


def test_connections_without_the_token_make_room_for_the_owner(served: Served) -> None:
    with ExitStack() as stack:
        head = f"GET /{served.server.token}/events HTTP/1.1\r\nHost: 127.0.0.1:{served.server.port}\r\n\r\n"
        owner = stack.enter_context(socket.create_connection(("127.0.0.1", served.server.port), timeout=10))
        owner.sendall(head.encode())
        assert owner.recv(4096)
        for _ in range(2):  # another user who sends nothing, again and again
            for _ in range(MOST_CONNECTIONS + 8):
                stack.enter_context(socket.create_connection(("127.0.0.1", served.server.port)))
            assert served.ask("/rows")[0] == 200
        served.ask("/rows")
        assert owner.recv(4096)  # its stream goes on


def test_events_arrive_and_the_end_of_the_server_ends_them(served: Served) -> None:
    with socket.create_connection(("127.0.0.1", served.server.port), timeout=10) as connection:
        head = f"GET /{served.server.token}/events HTTP/1.1\r\nHost: 127.0.0.1:{served.server.port}\r\n\r\n"
        connection.sendall(head.encode())
        text = b""
        while b'data: {"n": 0}\n\n' not in text:
            text += connection.recv(4096)
        assert b"text/event-stream" in text
        assert (served.server.streams, served.server.opened) == (1, True)
        served.server.close()  # no client delays the end: the timeout of this socket would fail the test
        served.server.close()
        while connection.recv(4096):
            pass
    until = time.monotonic() + 5
    while served.server.streams and time.monotonic() < until:
        time.sleep(0.01)
    assert served.server.streams == 0
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", served.server.port), timeout=1)


def test_a_closed_page_is_noticed(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local_server, "ALIVE", 0.02)
    with socket.create_connection(("127.0.0.1", served.server.port), timeout=10) as connection:
        head = f"GET /{served.server.token}/events HTTP/1.1\r\nHost: 127.0.0.1:{served.server.port}\r\n\r\n"
        connection.sendall(head.encode())
        connection.recv(1)
    until = time.monotonic() + 5
    while (served.server.streams or not served.server.opened) and time.monotonic() < until:
        time.sleep(0.01)
    assert (served.server.streams, served.server.opened) == (0, True)


def test_a_port_in_use_or_impossible_is_an_input_error(served: Served) -> None:
    for port in (served.server.port, 70_000, -1):
        with pytest.raises(InputError, match=f"--port: port {port}") as refused:
            Server({}, port)
        assert refused.value.exit_code == 2
    with Server({}) as other:
        port = other.port
    with Server({}, port) as again:  # free at once after the end
        assert again.port == port


def test_threads_end_with_the_server() -> None:
    before = threading.active_count()
    with Server({"GET /": lambda request: json_answer(1)}) as server:
        Served(server).ask("/")
    until = time.monotonic() + 5
    while threading.active_count() > before and time.monotonic() < until:
        time.sleep(0.01)
    assert threading.active_count() == before


def test_the_command_line_of_the_browser_does_not_show_the_token(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(webbrowser, "open", lambda url: opened.append(url) or True)
    assert open_page("http://127.0.0.1:1/secret/", 'a "title"')
    (url,) = opened
    file = Path(url.removeprefix("file://"))
    assert "secret" not in url
    assert "url=http://127.0.0.1:1/secret/" in file.read_text(encoding="utf-8")
    if os.name == "posix":
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
        assert stat.S_IMODE(file.parent.stat().st_mode) == 0o700


def test_without_a_display_no_browser_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(webbrowser, "open", lambda url: pytest.fail("a browser was tried"))
    if os.name == "posix":
        assert has_display() == (os.uname().sysname == "Darwin")
        assert open_page("http://127.0.0.1:1/x/", "t") is False
