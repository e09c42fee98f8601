"""Pages of commands without a browser: states of run, sweep and refinement, rows, changes."""

from __future__ import annotations

import json
import shutil
import threading
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.error import URLError

import numpy as np
import pytest

import cosim
from cosim.pages.work_pages import LiveRun, LiveSweep, WorkPage
from cosim.sweeps.workflow import sweep
from tests.conftest import ROOT
from tests.live_pages import ask, live_command, slow_scenario


@contextmanager
def events(page: WorkPage) -> Iterator[Iterator[dict[str, Any]]]:
    """The states that a page receives."""
    with urllib.request.urlopen(f"{page.url}events", timeout=30) as answer:
        yield (json.loads(line[6:]) for line in answer if line.startswith(b"data: "))


# -- run ----------------------------------------------------------------------------------------------


def test_rows_are_read_while_they_appear_changes_act_and_wrong_requests_are_refused(tmp_path: Path) -> None:
    path, page = slow_scenario(tmp_path, 0.6), LiveRun("mill")
    seen, told = list[dict[str, Any]](), list[dict[str, Any]]()
    changes = (
        {"mill.s_in": "5", "mill.r_in": "\u22122", "mill.i_in": "3", "mill.e_in": "second"},
        {"mill.r_in": "60 rpm", "mill.b_in": True},
    )

    def look() -> None:
        with events(page) as states:
            for state in states:
                seen.append(state)
                if state["phase"] == "running" and not told:
                    told.extend(ask(f"{page.url}set", change) for change in changes)
                if state["phase"] in {"finished", "failed"}:
                    break

    reader = threading.Thread(target=look)
    reader.start()
    try:
        ask(f"{page.url}set", {"mill.gain": 2}, 400)  # before the begin
        with page:
            ran = cosim.run(path, tmp_path / "o", observers=[page])
            page.report = tmp_path / "o" / "report.html"
        reader.join(30)
        phases = list(dict.fromkeys(state["phase"] for state in seen))
        assert phases[-1] == "finished"
        assert {"starting", "running"} <= {*phases}
        rows = [state["rows"] for state in seen]
        assert rows == sorted(rows)
        assert rows[-1] == 61
        assert len({*rows}) > 3  # they appear one after the other
        # text stays text; numbers may have a unit or a minus sign
        assert told[0]["set"] == {"mill.s_in": "5", "mill.r_in": -2.0, "mill.i_in": 3, "mill.e_in": 2}
        assert told[1]["set"] == {"mill.r_in": 60.0, "mill.b_in": True}
        assert ran["mill.r_in"][-1] == 60.0
        gain = next(v for v in ask(f"{page.url}variables") if v["name"] == "mill.gain")
        assert (gain["unit"], gain["bounds"], gain["start"], gain["input"]) == ("m", [0.0, 10.0], "1", False)
        raw = ask(f"{page.url}points", {"from": 0.0, "to": 0.6, "width": 1000, "curves": [[0, "mill.r_out"]]})
        assert np.frombuffer(raw)[63:124].tolist() == ran["mill.r_out"].tolist()
        requests = [("set", {"mill.gain": 2}), ("pause", True), ("stop", True), ("pause", "yes"), ("set", [1])]
        for place, content in requests:
            ask(page.url + place, content, 400)
        assert ask(f"{page.url}report.html").startswith(b"<!DOCTYPE html>")
    finally:
        page.close()


def test_a_page_that_is_never_opened_does_not_keep_the_command() -> None:
    page, said = LiveRun("x"), list[str]()
    page.update(phase="running")
    with page:
        pass
    page.wait_for_close(said.append, first=0.2, reload=0.1)
    assert len(said) == 1
    with pytest.raises(URLError):
        ask(f"{page.url}about")


# -- sweep and refinement ---------------------------------------------------------------------------------


def test_a_sweep_shows_its_runs_and_criteria_so_far(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    pytest.importorskip("SALib")
    path = slow_scenario(tmp_path, 0.05)
    with path.open("a", encoding="utf-8") as stream:
        stream.write("criteria: {peak: {of: mill.r_out, max: 3.0}}\n")
    (tmp_path / "vary.yaml").write_text("scenario: mill.yaml\nruns: 6\nvary: {mill.r_in: {uniform: [1, 5]}}\n")
    page = LiveSweep("vary")
    try:
        with page:
            swept = sweep(tmp_path / "vary.yaml", tmp_path / "o", in_process=True, report=False, observers=[page])
        state = page.state()
        assert (state["phase"], state["done"], state["total"], state["failed"]) == ("finished", 6, 6, 0)
        (criterion,), (record,) = state["criteria"], swept.record["criteria"]
        assert (criterion["met"], criterion["of"], criterion["max"]) == (record["met"], 6, 3.0)
        assert [criterion["low"], criterion["high"]] == record["ci95"]
    finally:
        page.close()


# -- command ------------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_the_example_runs_with_a_page_without_a_display(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(ROOT / "examples" / "live", tmp_path / "examples" / "live")
    cosim.build(tmp_path / "build" / "oven", f"{tmp_path / 'examples' / 'live' / 'oven.py'}:Oven")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    words = ("run", "examples/live/oven.yaml", "--set", "duration=100", "--no-report")
    with live_command(*words, folder=tmp_path) as (process, url):
        with urllib.request.urlopen(f"{url}events", timeout=60) as states:
            assert next(json.loads(line[6:])["rows"] for line in states if b'"finished"' in line) == 1001
        assert process.wait(60) == 0  # its page is closed
