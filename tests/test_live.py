"""Pages of commands without a browser: states of run, sweep and refinement, rows, changes."""

from __future__ import annotations

import http.client
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cosim
from cosim.pages.work_pages import LiveRefine, LiveRun, LiveSweep, WorkPage
from cosim.sweeps.workflow import sweep
from tests.live_pages import slow_scenario

ROOT = Path(__file__).resolve().parent.parent


def ask(page: WorkPage, path: str, content: Any = None) -> tuple[int, Any]:
    """Status and JSON of an answer; with content it is a POST."""
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=20)
    body = None if content is None else json.dumps(content)
    headers = {} if body is None else {"Content-Type": "application/json"}
    connection.request("GET" if body is None else "POST", f"/{page.token}/{path}", body, headers)
    answer = connection.getresponse()
    raw = answer.read()
    connection.close()
    is_json = "json" in (answer.getheader("Content-Type") or "")
    return answer.status, json.loads(raw) if is_json else raw


@contextmanager
def events(port: int, token: str) -> Iterator[Iterator[dict[str, Any]]]:
    """The states that a page receives."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    connection.request("GET", f"/{token}/events")
    answer = connection.getresponse()
    lines = iter(answer.readline, b"")
    try:
        yield (json.loads(line[6:]) for line in lines if line.startswith(b"data: "))
    finally:
        answer.close()
        connection.close()


# -- run ----------------------------------------------------------------------------------------------


def test_rows_are_read_while_they_appear_and_wrong_requests_are_refused(tmp_path: Path) -> None:
    path, (page, seen) = slow_scenario(tmp_path, 0.6), (LiveRun("mill"), list[dict[str, Any]]())

    def look() -> None:
        with events(page.port, page.token) as states:
            for state in states:
                seen.append(state)
                if state["phase"] in {"finished", "failed"}:
                    break

    reader = threading.Thread(target=look)
    reader.start()
    try:
        assert ask(page, "set", {"mill.gain": 2})[0] == 400  # before the begin
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
        assert seen[-1]["report"]
        (run,), (signals,) = (ask(page, "about")[1][key] for key in ("runs", "sets"))
        assert (run["rows"], run["from"], run["to"]) == (61, 0.0, 0.6)
        assert signals[0] == list(ran.names)
        variables = ask(page, "variables")[1]
        gain = next(v for v in variables if v["name"] == "mill.gain")
        assert (gain["unit"], gain["bounds"], gain["start"], gain["input"]) == ("m", [0.0, 10.0], "1", False)
        assert next(v for v in variables if v["name"] == "mill.e_in")["items"] == ["first", "second"]
        curves = [[0, "mill.r_out"], [0, "mill.h"]]
        _, raw = ask(page, "points", {"from": 0.0, "to": 0.6, "width": 1000, "curves": curves})
        numbers = np.frombuffer(raw)
        assert numbers[:3].tolist() == [61, 1, 1]
        assert numbers[64:125].tolist() == ran["mill.r_out"].tolist()
        assert numbers[128:].tolist() == ran["mill.h"].tolist()
        requests = [("set", {"mill.gain": 2}), ("pause", True), ("stop", True), ("pause", "yes"), ("set", [1])]
        assert [ask(page, *request)[0] for request in requests] == [400] * 5
        status, report = ask(page, "report.html")
        assert (status, report[:15]) == (200, b"<!DOCTYPE html>")
    finally:
        page.close()


def test_a_page_that_is_never_opened_does_not_keep_the_command() -> None:
    page, said = LiveRun("x"), list[str]()
    page.update(phase="running")
    with page:
        pass
    page.wait_for_close(said.append, first=0.2, reload=0.1)
    assert len(said) == 1
    with pytest.raises(ConnectionRefusedError):
        ask(page, "about")


def test_text_stays_text_and_numbers_may_have_a_unit_or_a_minus_sign(tmp_path: Path) -> None:
    page = LiveRun("mill")
    told: list[tuple[int, Any]] = []

    def change() -> None:
        while page.state()["phase"] != "running":
            time.sleep(0.02)
        told.append(
            ask(page, "set", {"mill.s_in": "5", "mill.r_in": "\u22122", "mill.i_in": "3", "mill.e_in": "second"})
        )
        told.append(ask(page, "set", {"mill.r_in": "60 rpm", "mill.b_in": True}))

    sender = threading.Thread(target=change)
    sender.start()
    try:
        ran = cosim.run(slow_scenario(tmp_path, 0.6), observers=[page])
        sender.join(20)
    finally:
        page.close()
    assert [status for status, _ in told] == [200, 200]
    assert told[0][1]["set"] == {"mill.s_in": "5", "mill.r_in": -2.0, "mill.i_in": 3, "mill.e_in": 2}
    assert told[1][1]["set"] == {"mill.r_in": 60.0, "mill.b_in": True}
    assert ran["mill.r_in"][-1] == 60.0


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
        assert criterion["name"] == record["name"]
        assert (criterion["met"], criterion["of"], criterion["max"]) == (record["met"], 6, 3.0)
        assert [criterion["low"], criterion["high"]] == record["ci95"]
        assert sum(criterion["counts"]) == 6
    finally:
        page.close()


@pytest.mark.thorough
def test_a_search_reports_its_ranking(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "examples" / "tanks", tmp_path / "tanks")
    subprocess.run([sys.executable, "make_logs.py", "."], cwd=tmp_path / "tanks", check=True)
    from cosim.refinement.workflow import refine

    page = LiveRefine("tanks")
    try:
        with page:
            result = refine(tmp_path / "tanks" / "study.yaml", tmp_path / "o", page)
        state = page.state()
        assert state["fitted"] > 2
        assert state["ranking"][0]["names"] == [effect["name"] for effect in result.record["effects"]] == ["leak"]
    finally:
        page.close()


# -- command ------------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_the_example_runs_with_a_page_and_without_a_display_its_address_is_printed(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "examples" / "live", tmp_path / "examples" / "live")
    cosim.build(tmp_path / "build" / "oven", f"{tmp_path / 'examples' / 'live' / 'oven.py'}:Oven")
    hidden = {k: v for k, v in os.environ.items() if k not in {"DISPLAY", "WAYLAND_DISPLAY", "BROWSER"}}
    command = [sys.executable, "-m", "cosim", "run", "examples/live/oven.yaml", "--live", "-q"]
    command += ["--set", "duration=100", "--no-report"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, cwd=tmp_path, env=hidden, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stderr is not None
        address = next(line for line in process.stderr if line.startswith("live page: http://127.0.0.1:"))
        port, token = address.strip().removeprefix("live page: http://127.0.0.1:").strip("/").split("/")
        with events(int(port), token) as states:
            last = next(state for state in states if state["phase"] in {"finished", "failed"})
        assert (last["phase"], last["rows"], last["title"]) == ("finished", 1001, "oven")
        assert {*last["values"]} == {"oven.power", "oven.fan", "oven.room"}
        assert process.wait(30) == 0  # its page is closed
