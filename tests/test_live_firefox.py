"""The live page in Firefox, driven by WebDriver BiDi: rows appear, a change acts, stop keeps the rows."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from cosim.storage.results import read_results
from tests.live_pages import live_command, slow_scenario
from tests.test_live_browser import INK

FIREFOX = shutil.which("firefox-esr") or shutil.which("firefox")
PATIENCE = 60.0  # [s] on a busy machine
pytestmark = [pytest.mark.thorough, pytest.mark.skipif(FIREFOX is None, reason="no Firefox on this machine")]


class Page:
    """A page of Firefox, by its BiDi connection."""

    def __init__(self, connection: Any) -> None:
        self._connection, self._numbers = connection, count(1)
        self.call("session.new", capabilities={})
        self.context = self.call("browsingContext.getTree")["contexts"][0]["context"]

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command and return its result."""
        number = next(self._numbers)
        self._connection.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._connection.recv(PATIENCE))
            if answer.get("id") == number:
                assert answer["type"] == "success", answer
                result: dict[str, Any] = answer["result"]
                return result

    def evaluate(self, expression: str) -> Any:
        """Return the value of JavaScript."""
        target = {"context": self.context}
        result = self.call("script.evaluate", expression=expression, target=target, awaitPromise=True)
        assert result["type"] == "success", result
        return result["result"].get("value")

    def until(self, expression: str) -> None:
        """Wait until JavaScript is true."""
        end = time.monotonic() + PATIENCE
        while not self.evaluate(f"Boolean({expression})"):
            assert time.monotonic() < end, expression
            time.sleep(0.05)


@contextmanager
def firefox(profile: Path) -> Iterator[Page]:
    """A page of a new Firefox without window."""
    client = pytest.importorskip("websockets.sync.client", reason="no websockets")
    command = [str(FIREFOX), "--headless", "--no-remote", "--profile", str(profile), "--remote-debugging-port", "0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stderr is not None
            found = (re.search(r"BiDi listening on (ws://\S+)", line) for line in process.stderr)
            address = next(match[1] for match in found if match)
            threading.Thread(target=process.stderr.read, daemon=True).start()  # so that its pipe never is full
            with client.connect(f"{address}/session", max_size=None, open_timeout=PATIENCE) as connection:
                yield Page(connection)
        finally:
            process.kill()


def test_rows_appear_a_change_acts_and_stop_keeps_the_rows(tmp_path: Path) -> None:
    profile = tmp_path / "profile"
    profile.mkdir()
    arguments = ("run", slow_scenario(tmp_path), "--out", tmp_path / "o")
    with live_command(*arguments, folder=tmp_path) as (process, url), firefox(profile) as page:
        page.call("browsingContext.navigate", context=page.context, url=url, wait="complete")
        page.until("document.documentElement.dataset.live === 'running'")
        page.until(f"{INK} > 20")  # rows appear
        page.evaluate(
            "(() => { const all = [...document.querySelectorAll('.change')];"
            " const f = all.find((e) => e.textContent.includes('mill.gain'));"
            " const i = f.querySelector('input:not([type=range])'); i.value = '4';"
            " i.dispatchEvent(new Event('input', {bubbles: true})); f.querySelector('button').click(); })()"
        )
        page.until("document.querySelector('#log li')?.textContent.includes('mill.gain = 4')")
        page.until(
            "[...document.querySelectorAll('.legend > .entry')].some((e) =>"
            " e.children[0].textContent === 'mill.r_out' && parseFloat(e.children[1].textContent) === 8)"
        )  # the effect: r_out = 4·2
        page.evaluate("[...document.querySelectorAll('button')].find((b) => b.textContent.trim() === 'Stop').click()")
        page.until("document.documentElement.dataset.live === 'stopped'")
        page.call("browser.close")
        _, errors = process.communicate(timeout=PATIENCE)
        assert process.returncode == 130, errors
    assert read_results(tmp_path / "o" / "results.csv")["mill.r_out"][-1] == 8.0
