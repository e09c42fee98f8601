"""Live pages without a browser: extremes of any number of rows, states of run, sweep and refinement."""

from __future__ import annotations

import http.client
import json
import os
import shutil
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import cosim
from cosim.live.envelope import Envelope
from cosim.live.live_page import LivePage
from cosim.live.live_refine import LiveRefine
from cosim.live.live_run import LiveRun
from cosim.live.live_sweep import LiveSweep
from cosim.sweeps.workflow import sweep
from tests.live_pages import slow_scenario

ROOT = Path(__file__).resolve().parent.parent


def ask(page: LivePage, path: str, content: Any = None) -> tuple[int, Any]:
    """Status and JSON of an answer; with content it is a POST."""
    connection = http.client.HTTPConnection("127.0.0.1", page.server.port, timeout=20)
    body = None if content is None else json.dumps(content)
    headers = {} if body is None else {"Content-Type": "application/json"}
    connection.request("GET" if body is None else "POST", f"/{page.server.token}/{path}", body, headers)
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


# -- extremes -----------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.integers(0, 700), min_size=1, max_size=12),
    st.integers(1, 3),
    st.integers(0, 3000),
    st.integers(0, 3000),
    st.integers(1, 50),
    st.integers(0, 10**6),
)
def test_groups_of_rows_have_the_least_and_the_largest_of_their_rows(
    parts: list[int], columns: int, first: int, end: int, count: int, seed: int
) -> None:
    envelope, rng = Envelope(columns), np.random.default_rng(seed)
    envelope.limit = 64  # so that blocks are joined often
    values = rng.normal(size=(sum(parts), columns))
    begin = 0
    for part in parts:
        envelope.add(values[begin : begin + part])
        begin += part
    assert envelope.rows == len(values)
    if len(values):
        assert (envelope.last() == values[-1]).all()
    found = envelope.extremes(range(columns), first, end, count)
    assert found.low.shape == found.high.shape
    assert found.low.shape[1] <= 2 * count + 1
    for k in range(found.low.shape[1]):
        begin = found.first + k * found.size
        rows, asked = values[begin : begin + found.size], values[begin : min(begin + found.size, end)]
        low, high = found.low[:, k], found.high[:, k]
        assert (rows.min(axis=0) <= low).all()
        assert (high <= rows.max(axis=0)).all()
        assert len(asked)
        assert (low <= asked.min(axis=0)).all()
        assert (high >= asked.max(axis=0)).all()
    wanted = min(end, len(values))
    if first < wanted:
        assert found.first <= first
        assert found.first + found.low.shape[1] * found.size >= wanted


# -- run ----------------------------------------------------------------------------------------------


def test_rows_are_read_while_they_appear_and_wrong_requests_are_refused(tmp_path: Path) -> None:
    path, (page, seen) = slow_scenario(tmp_path, 0.6), (LiveRun("mill"), list[dict[str, Any]]())

    def look() -> None:
        with events(page.server.port, page.server.token) as states:
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
        about = ask(page, "about")[1]
        names = [signal["name"] for signal in about["signals"]]
        assert names == list(ran.names)
        gain = next(v for v in about["variables"] if v["name"] == "mill.gain")
        assert (gain["unit"], gain["bounds"], gain["start"], gain["input"]) == ("m", [0.0, 10.0], "1", False)
        gear = next(v for v in about["variables"] if v["name"] == "mill.e_in")
        assert gear["items"] == ["first", "second"]
        places = [names.index("mill.r_out"), names.index("mill.h")]
        _, raw = ask(page, "rows?" + urlencode({"signals": ",".join(map(str, places)), "count": 1000}))
        first, every, count, signals, total = struct.unpack("<5d", raw[:40])
        assert (first, every, count, signals, total) == (0.0, 0.01, 61, 2, 61)
        numbers = np.frombuffer(raw[40:])
        for k, place in enumerate(places):
            assert numbers[61 * k : 61 * (k + 1)].tolist() == ran[names[place]].tolist()
        assert numbers[-2:].tolist() == [ran["mill.r_out"][-1], ran["mill.h"][-1]]
        _, raw = ask(page, f"rows?signals={places[0]}&from=0.3&to=0.4&count=1000")
        assert struct.unpack("<5d", raw[:40])[2] in {12.0, 13.0, 14.0}  # a row beyond each end
        for wrong in ("signals=x", "signals=-1", "signals=999", "signals=0&from=nan", "signals=0&count=many"):
            status, _ = ask(page, f"rows?{wrong}")
            assert status == 400
        for path_, content in (("set", {"mill.gain": 2}), ("pause", True), ("stop", True)):
            status, _ = ask(page, path_, content)
            assert status == 400
        assert ask(page, "pause", "yes")[0] == 400
        assert ask(page, "set", [1])[0] == 400
        status, report = ask(page, "report.html")
        assert (status, report[:15]) == (200, b"<!DOCTYPE html>")
    finally:
        page.server.close()


def test_a_page_that_is_never_opened_does_not_keep_the_command() -> None:
    page, said = LiveRun("x"), list[str]()
    page.update(phase="running")
    with page:
        pass
    page.wait_for_close(said.append, first=0.2, reload=0.1)
    assert len(said) == 1
    assert page.server.closing.is_set()


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
        page.server.close()
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
        page.server.close()


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
        page.server.close()


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


def test_a_port_in_use_is_told_before_anything_runs(tmp_path: Path) -> None:
    page = LiveRun("x")
    try:
        command = [sys.executable, "-m", "cosim", "run", "mill.yaml", "--port", str(page.server.port)]
        slow_scenario(tmp_path)
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
        assert done.returncode == 2
        assert f"--port: port {page.server.port} is in use" in done.stderr
        assert not (tmp_path / "results").exists()
    finally:
        page.server.close()
