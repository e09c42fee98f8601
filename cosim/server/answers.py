"""Requests to the local server and its answers: JSON, pages, files with ranges, and streams of events."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.base.messages import printable_json

BASE_POLICY = "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
SANDBOX = "sandbox allow-scripts allow-downloads allow-modals"  # a page in an origin of its own


@dataclass(frozen=True)
class Request:
    """A request with a valid token.

    Attributes:
        path: Decoded path behind the token, e.g. `rows`; behind a route that ends with a slash, its rest.
        query: Fields of the query; of a repeated field the last one.
        content: Decoded JSON of a POST.
        is_closing: Function that waits up to some seconds, and returns whether the server is closing.
    """

    path: str
    query: Mapping[str, str] = field(default_factory=dict)
    content: Any = None
    is_closing: Callable[[float], bool] = lambda seconds: False


@dataclass(frozen=True)
class Answer:
    """An answer with its whole body, or with a file or events in place of the body.

    Attributes:
        file: File to send, in part if the request asks for a range.
        is_temporary: Whether the file is removed afterwards.
        events: Contents of server-sent events; None keeps the connection alive.
    """

    body: bytes = b""
    kind: str = "application/json"
    status: int = 200
    headers: Mapping[str, str] = field(default_factory=dict)
    file: Path | None = None
    is_temporary: bool = False
    events: Iterator[Any] | None = field(default=None, compare=False)


Handler = Callable[[Request], Answer]


def json_answer(content: Any, status: int = 200) -> Answer:
    """Return an answer with JSON."""
    return Answer(json_text(content).encode(), "application/json; charset=utf-8", status)


def json_text(content: Any) -> str:
    """Return JSON whose texts a page can show: control characters are escapes."""
    return printable_json(json.dumps(content))


def page_answer(html: str, *, alone: bool = False) -> Answer:
    """Return an answer with a page that may run and show its own inline scripts and styles only.

    Args:
        alone: Whether the page gets an origin of its own, so that its scripts cannot reach the server, e.g. a report.
    """
    return Answer(html.encode(), "text/html; charset=utf-8", headers={"Content-Security-Policy": _policy(html, alone)})


def report_answer(path: Path) -> Answer:
    """Return an answer with a finished report, which cannot reach the server; 404 without the file."""
    try:
        return page_answer(path.read_text(encoding="utf-8"), alone=True)
    except OSError:
        return json_answer({"error": "not found"}, 404)


def _policy(html: str, alone: bool) -> str:
    """Return the Content-Security-Policy of a page, with the hashes of its scripts and styles."""
    scripts = re.findall(r"<script>(.*?)</script>", html, re.DOTALL)
    styles = re.findall(r"<style>(.*?)</style>", html, re.DOTALL)
    parts = [BASE_POLICY, f"script-src {_hashes(scripts)}", f"style-src-elem {_hashes(styles)}"]
    parts += ["style-src-attr 'unsafe-inline'", "img-src data: blob:"]  # Charts place their ticks by attributes.
    return "; ".join([*parts, SANDBOX if alone else "connect-src 'self'"])


def _hashes(texts: list[str]) -> str:
    digests = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in texts]
    return " ".join(f"'sha256-{digest}'" for digest in digests) or "'none'"


def byte_range(header: str, size: int) -> tuple[int, int] | None:
    """Return first byte and end of a range request, None for the whole file.

    A header of another form, or with several ranges, stands for the whole file, as RFC 9110 allows.

    Raises:
        ValueError: The range lies outside the file.
    """
    match = re.fullmatch(r"bytes=(\d*)-(\d*)", header.strip())
    if match is None or match.groups() == ("", ""):
        return None
    first, last = match.groups()
    if not first:
        begin, end = max(0, size - int(last)), size
    else:
        begin, end = int(first), min(size, int(last) + 1) if last else size
        if last and int(last) < int(first):
            return None  # no range at all
    if begin >= end:
        raise ValueError("the range lies outside the file")
    return begin, end
