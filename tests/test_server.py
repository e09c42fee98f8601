"""The local server answers pages of its own user alone: token, host, origin, paths, bodies, ranges, streams."""

from __future__ import annotations

import http.client
import json
import os
import re
import socket
import stat
import time
import webbrowser
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from starlette.responses import FileResponse

from cosim.core.errors import InputError
from cosim.pages.server import MAX_BODY, Handler, Json, ServedPage, html_response, open_page

CONTENT = bytes(range(256)) * 4
PAGE = "<!DOCTYPE html><style>p { color: red }</style><p style='left: 1px'>x</p><script>go()</script>"


class Served(ServedPage):
    """A page with routes, and what its handlers have received."""

    def __init__(self, file: Path) -> None:
        self.file, self.received = file, list[Any]()
        super().__init__(PAGE, n=0)

    def routes(self) -> Mapping[str, Handler]:
        def crash(request: Any, _: Any) -> Any:
            raise KeyError("gone")

        def refuse(request: Any, _: Any) -> Any:
            raise InputError.at(Path("--set"), "no such thing")

        return {
            "GET /rows": lambda request, _: Json({"query": dict(request.query_params)}),
            "GET /file": lambda request, _: FileResponse(self.file),
            "GET /crash": crash,
            "GET /refuse": refuse,
            "POST /set": lambda request, content: self.received.append(content) or Json({}),
        }

    def ask(
        self, path: str, method: str = "GET", *, token: str | None = None, body: Any = None, **headers: str
    ) -> tuple[int, dict[str, str], bytes]:
        """Status, headers and body of an answer; `path` is behind the token."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=10)
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        if body is not None:
            named.setdefault("Content-Type", "application/json")
        connection.request(method, f"/{self.token if token is None else token}{path}", body, named)
        answer = connection.getresponse()
        got = answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
        connection.close()
        return got

    def raw(self, text: bytes) -> bytes:
        """The answer to bytes as they are."""
        with socket.create_connection(("127.0.0.1", self.port), timeout=10) as connection:
            connection.sendall(text)
            connection.shutdown(socket.SHUT_WR)
            return b"".join(iter(lambda: connection.recv(65536), b""))


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    (tmp_path / "rows.bin").write_bytes(CONTENT)
    with Served(tmp_path / "rows.bin") as page:
        yield page


def test_an_answer_is_never_stored_framed_or_shared_and_a_page_runs_its_own_scripts_alone(served: Served) -> None:
    assert len(served.token) >= 40
    status, headers, body = served.ask("/rows?a=1&b=x%20y&a=2")
    assert (status, json.loads(body)) == (200, {"query": {"a": "2", "b": "x y"}})
    names = ("cache-control", "x-frame-options", "referrer-policy", "x-content-type-options")
    assert [headers[name] for name in names] == ["no-store", "DENY", "no-referrer", "nosniff"]
    assert not [name for name in headers if name.startswith("access-control") or name in {"set-cookie", "server"}]
    status, headers, body = served.ask("/")
    policy = headers["content-security-policy"]
    assert (status, body.decode()) == (200, PAGE)
    assert "default-src 'none'" in policy
    assert re.search(r"script-src 'sha256-[\w+/]+='(;|$)", policy)
    alone = html_response(PAGE, alone=True).headers["content-security-policy"]
    assert "connect-src" not in alone
    assert "sandbox allow-scripts" in alone


@pytest.mark.parametrize("token", ["", "%00", "..", "right-", "rightx", "right/right"])
def test_a_wrong_token_finds_nothing_and_changes_nothing(served: Served, token: str) -> None:
    token = token.replace("right-", served.token[:-1]).replace("right", served.token)
    for path, method in (("/", "GET"), ("/rows", "GET"), ("/none", "GET"), ("/set", "POST")):
        status, _, body = served.ask(path, method, token=token, body="1" if method == "POST" else None)
        assert (status, json.loads(body)) == (404, {"error": "not found"})
    assert served.received == []


@pytest.mark.parametrize(
    "hosts", [(), ("evil.example",), ("localhost:{port}",), ("127.0.0.1",), ("127.0.0.1:{port}", "x")]
)
def test_a_foreign_or_missing_or_repeated_host_is_refused(served: Served, hosts: tuple[str, ...]) -> None:
    lines = "".join(f"Host: {host.format(port=served.port)}\r\n" for host in hosts)
    for method, path in (("GET", "rows"), ("POST", "set")):
        more = "Content-Type: application/json\r\nContent-Length: 1\r\n"
        answer = served.raw(f"{method} /{served.token}/{path} HTTP/1.1\r\n{lines}{more}\r\n1".encode())
        assert answer.startswith((b"HTTP/1.1 403 ", b"HTTP/1.1 400 "))
    assert served.received == []


@pytest.mark.parametrize("origin", ["https://evil.example", "null", "http://127.0.0.1:1"])
def test_a_foreign_origin_can_neither_read_nor_change(served: Served, origin: str) -> None:
    assert served.ask("/rows", Origin=origin)[0] == 403
    assert served.ask("/set", "POST", body="1", Origin=origin)[0] == 403
    assert served.ask("/set", "POST", body="1", Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="no-cors")[0] == 403
    assert served.received == []
    assert served.ask("/", Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="navigate")[0] == 200  # from the file that leads
    assert served.ask("/set", "POST", body="1", Origin=served.origin)[0] == 200
    assert served.received == [1]


@pytest.mark.parametrize(
    ("path", "method", "status", "body", "headers"),
    [
        ("/set", "GET", 405, None, {}),
        ("/..%2f..%2fetc%2fpasswd", "GET", 404, None, {}),
        ("/set", "POST", 415, "a=1", {"Content_Type": "application/x-www-form-urlencoded"}),
        ("/set", "POST", 400, "[" * 50_000, {}),
        ("/set", "POST", 413, b" " * MAX_BODY + b"1", {}),
        ("/crash", "GET", 500, None, {}),
        ("/refuse", "GET", 400, None, {}),
    ],
)
def test_methods_paths_bodies_and_faults_have_their_statuses(
    served: Served, path: str, method: str, status: int, body: Any, headers: dict[str, str]
) -> None:
    got, _, content = served.ask(path, method, body=body, **headers)
    assert (got, [*json.loads(content)]) == (status, ["error", "kind"] if path == "/refuse" else ["error"])
    assert served.received == []
    assert served.ask("/rows")[0] == 200


def test_what_is_no_http_gets_no_token_and_a_file_is_sent_in_the_range_asked_for(served: Served) -> None:
    for text in (b"\x00\x01\r\n\r\n", b"GET\r\n\r\n", b"A" * 70_000, b""):
        assert served.token.encode() not in served.raw(text)
    assert served.ask("/file")[2] == CONTENT
    status, headers, body = served.ask("/file", Range="bytes=1000-")
    assert (status, headers["content-range"], body) == (206, "bytes 1000-1023/1024", CONTENT[1000:])
    assert served.ask("/file", Range="bytes=1024-")[0] == 416


def test_states_arrive_a_closed_page_is_noticed_and_the_end_of_the_server_ends_all(served: Served) -> None:
    def until(streams: int) -> bool:
        end = time.monotonic() + 8
        while served.streams != streams and time.monotonic() < end:
            time.sleep(0.02)
        return served.streams == streams

    head = f"GET /{served.token}/events HTTP/1.1\r\nHost: 127.0.0.1:{served.port}\r\n\r\n".encode()
    with socket.create_connection(("127.0.0.1", served.port), timeout=10) as connection:
        connection.sendall(head)
        text = b""
        while b'data: {"n": 0' not in text:
            text += connection.recv(4096)
        served.update(m=1)
        while b'"m": 1}' not in text:
            text += connection.recv(4096)
        assert until(1)
    assert until(0)
    with socket.create_connection(("127.0.0.1", served.port), timeout=10) as connection:
        connection.sendall(head)
        assert connection.recv(4096)
        served.close()
        while connection.recv(4096):
            pass
    assert served.opened
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", served.port), timeout=1)


def test_a_port_in_use_or_impossible_is_an_input_error(served: Served) -> None:
    for port in (served.port, 70_000, -1):
        with pytest.raises(InputError) as refused:
            ServedPage("", port)
        assert refused.value.exit_code == 2
    served.close()
    with ServedPage("", served.port) as again:  # free at once after the end
        assert again.port == served.port


def test_the_command_line_of_the_browser_does_not_show_the_token(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda url: opened.append(url) or True)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    if os.name == "posix" and os.uname().sysname != "Darwin":
        assert not open_page("http://127.0.0.1:1/x/", "t")  # without a display no browser is tried
    monkeypatch.setenv("DISPLAY", ":0")
    assert open_page("http://127.0.0.1:1/secret/", 'a "title"')
    (url,) = opened
    file = Path(url.removeprefix("file://"))
    assert "secret" not in url
    assert "url=http://127.0.0.1:1/secret/" in file.read_text(encoding="utf-8")
    if os.name == "posix":
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
        assert stat.S_IMODE(file.parent.stat().st_mode) == 0o700
