"""Pages for tests: a slow scenario with variables of every kind, a command with its page, and what a page answers."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.error import HTTPError

from tests.deeds import deeds_fmu
from tests.typed import typed_fmu

GAIN = 'variability="tunable"><Real start="1"/>'
BOUNDED = 'variability="tunable"><Real start="1" min="0" max="10" unit="m"/>'
SCENARIO = """name: mill
duration: {duration}
step: 0.01
components:
  mill: {{fmu: typed.fmu, start: {{r_in: 2.0}}}}
  slow: {{fmu: slow.fmu}}
connections:
  - {{from: slow.y1, to: slow.u1}}
"""


def slow_scenario(folder: Path, duration: float = 60.0) -> Path:
    """A mill with r_out = gain·r_in, gain in 0 … 10, and an FMU that takes 20 ms a step."""
    typed_fmu(folder, units=("rpm", "rad/s"), **{GAIN: BOUNDED})
    deeds_fmu(folder / "slow.fmu", "DoStep", "slow", 0)
    path = folder / "mill.yaml"
    path.write_text(SCENARIO.format(duration=duration), encoding="utf-8")
    return path


@contextmanager
def live_command(*arguments: str | Path, folder: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start a command with --live; yield the process and the address of its page."""
    command = [sys.executable, "-m", "cosim", *map(str, arguments), "--live"]
    pipe = subprocess.PIPE
    with subprocess.Popen(
        command, cwd=folder, stdin=subprocess.DEVNULL, stdout=pipe, stderr=pipe, text=True
    ) as process:
        try:
            assert process.stderr is not None
            address = next((found for line in process.stderr if (found := re.search(r"http://\S+", line))), None)
            assert address is not None, process.communicate()
            yield process, address.group()
        finally:
            if process.poll() is None:
                process.kill()


def ask(url: str, content: Any = None, status: int = 200) -> Any:
    """Return the answer of a page, which must have a status; with content, as JSON or in bytes, it is a POST."""
    body = content if content is None or isinstance(content, bytes) else json.dumps(content).encode()
    request = urllib.request.Request(url, body, {"Content-Type": "application/json"})
    try:
        answer = urllib.request.urlopen(request, timeout=20)
    except HTTPError as refused:
        answer = refused
    with answer:
        told = json.load(answer) if "json" in answer.headers["Content-Type"] else answer.read()
        assert answer.status == status, told
        return told
