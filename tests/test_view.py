"""The signal browser without a browser: extremes of blocks, tables, derived signals, its server, bad input."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.parse import urlencode

import numpy as np
import pytest
from typer.testing import CliRunner

from cosim.core.errors import InputError
from cosim.core.scratch import process_folder
from cosim.files.results import Results
from cosim.files.run_entries import entries
from cosim.pages import tables
from cosim.pages.layouts import Layouts
from cosim.pages.rows import TIME, Recording, Store
from cosim.pages.runs import RunPlace, ViewedRun, find_runs, open_runs
from cosim.pages.server import ServedPage
from cosim.pages.tables import ColumnTypes, open_rows
from cosim.pages.view_page import view_page
from cosim.verbs.cli import command_line

RNG = np.random.default_rng
Array = np.ndarray[Any, np.dtype[np.float64]]
Ask = Callable[..., Any]


def times(kind: str, rows: int) -> Array:
    """Uniform times, bursts with long pauses, or events: many rows of one time."""
    rng = RNG(rows)
    steps = {
        "uniform": np.full(rows, 1e-3),
        "bursts": np.where(rng.random(rows) < 0.001, 50.0, 1e-4),
        "events": np.where(rng.random(rows) < 0.5, 0.0, 1e-2),
    }[kind]
    return np.cumsum(steps)


def recording(time: Array, values: Array, folder: Path | None, rest: int = 0) -> Recording:
    """A recording in memory or in a file, to which rows are added in parts."""
    if folder is None:
        return Recording({TIME: time, "x": values}, {"x": "m"}, time.size)
    folder.mkdir()
    store, rng, row = Store(folder, {"x": "m"}), RNG(5), 0
    while row < time.size - rest:
        end = min(time.size - rest, row + int(rng.integers(1, 20_000)))
        store.append(np.vstack((time[row:end], values[row:end])))
        row = end
    if rest:
        store.append(np.vstack((time[row:], values[row:])))
    return store


# -- pictures ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["uniform", "bursts", "events"])
@pytest.mark.parametrize(
    ("rows", "is_stored"), [(1, False), (17, True), (5000, True), (300_000, False), (100_000, True)]
)
def test_a_picture_has_the_extremes_of_the_rows_in_every_pixel_column(
    kind: str, rows: int, is_stored: bool, tmp_path: Path
) -> None:
    time, rng = times(kind, rows), RNG(1)
    values = rng.standard_normal(rows)
    values[rng.random(rows) < 0.2] = np.nan
    values[rows // 3 : rows // 2] = np.nan
    width = 200
    for rest in (0, 3) if is_stored else (0,):
        record = recording(time, values, tmp_path / str(rest) if is_stored else None, min(rest, rows))
        assert (record.rows, *record.span()) == (rows, time[0], time[-1])
        for begin, end in ((time[0], time[-1] + 1e-9), (time[rows // 4], time[rows // 2] + 1e-3)):
            picture = record.picture(begin, end, width)
            low, high = picture.points("x")
            assert picture.time.size <= max(4 * width, width + 3)
            assert np.all(np.diff(picture.time) >= 0.0)
            inside = (time >= begin) & (time <= end)
            good = values[inside & np.isfinite(values)]
            if good.size:  # no peak is lost
                assert np.nanmin(low) <= good.min()
                assert np.nanmax(high) >= good.max()
            # Each row lies within the extremes of a point at most a pixel column and a block away.
            pixel = (end - begin) / width
            for row in rng.choice(np.flatnonzero(inside & np.isfinite(values)), 20) if good.size else ():
                near = np.abs(picture.time - time[row]) <= 1.6 * pixel
                assert np.nanmin(low[near]) <= values[row] <= np.nanmax(high[near])


def test_a_wide_gap_is_a_gap_and_a_pause_between_bursts_is_no_block() -> None:
    time = np.concatenate([np.arange(50_000) * 1e-3, 1000.0 + np.arange(50_000) * 1e-3])
    values = np.sin(time)
    values[20_000:30_000] = np.nan
    record = recording(time, values, None)
    far = record.picture(0.0, 1050.0, 500)
    assert not ((far.time > 52.0) & (far.time < 998.0)).any()
    near = record.picture(0.0, 50.0, 500)
    inside = (near.time > 20.2) & (near.time < 29.8)
    assert np.isnan(near.points("x")[0][inside]).all()
    assert np.isfinite(near.points("x")[0][~inside]).mean() > 0.98


# -- tables --------------------------------------------------------------------------------------------


def table(path: Path, rows: int = 30_000) -> Results:
    rng = RNG(3)
    values = np.cumsum(rng.standard_normal((rows, 3)), axis=0)
    values[100:5000, 1] = np.nan
    time = np.cumsum(np.where(rng.random(rows) < 0.1, 0.0, 1e-3))
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as stream:
        stream.write("time,a.x [m],a,A [N],word\n")
        stream.writelines(
            f"{t!r},{','.join('' if np.isnan(v) else repr(v) for v in row)},on\n"
            for t, row in zip(time.tolist(), values.tolist(), strict=True)
        )
    return Results(time, ("a.x", "a", "A"), values, {"a.x": "m", "a": "", "A": "N"})


@pytest.fixture(params=[False, True], ids=["memory", "files"])
def stored(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Read small tables as they are, or convert them too."""
    if request.param:
        monkeypatch.setattr(tables, "SMALL", 0)
    return bool(request.param)


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".mat"])
def test_a_converted_table_gives_what_memory_gives(tmp_path: Path, suffix: str, stored: bool) -> None:
    results, path = table(tmp_path / "results.csv"), tmp_path / f"results{suffix}"
    if suffix != ".csv":
        results.write(path)
    seen: list[tuple[int, int]] = []
    rows = open_rows(path, ColumnTypes(), lambda done, total: seen.append((done, total)))
    assert isinstance(rows, Store) is (stored or path.stat().st_size > 4e6)
    assert all(done <= total for done, total in seen)
    assert rows.units == {"a.x": "m", "a": "", "A": "N"}
    columns = {TIME: results.time, **{name: results[name] for name in results.columns}}
    memory = Recording(columns, rows.units, rows.rows)
    places = np.array([5, 29_000, 4097, 4096])
    for name in results.columns:
        np.testing.assert_array_equal(rows.read(name), results[name])
        np.testing.assert_array_equal(rows.take(name, places), results[name][places])
        for begin, end in ((0.0, 27.0), (3.0, 9.0), (5.0, 5.1)):
            ours, theirs = (each.picture(begin, end, 100) for each in (rows, memory))
            np.testing.assert_array_equal(ours.time, theirs.time)
            np.testing.assert_array_equal(ours.points(name), theirs.points(name))
    assert open_rows(path, ColumnTypes(), lambda done, total: pytest.fail("converted twice")).rows == rows.rows


def test_a_changed_table_is_converted_again_and_old_conversions_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tables, "SMALL", 0)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path, cache = tmp_path / "run" / "results.csv", tmp_path / "cache" / "cosim" / "view"
    table(path, 5000)
    assert open_rows(path, ColumnTypes()).rows == 5000
    (first,) = cache.iterdir()
    table(path, 6000)
    os.utime(first, (0.0, 0.0))
    assert open_rows(path, ColumnTypes()).rows == 6000
    (second,) = cache.iterdir()
    assert second != first
    assert [p.name for p in path.parent.iterdir()] == ["results.csv"]


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("time,x\n0,1\n1,2\n0.5,3\n", "results.csv:4"),
        ("time,x\n0,1\n1\n", "results.csv:3"),
        ("time,x\n0,1\n,2\n", "results.csv"),
        ("time,x\n", "results.csv"),
        ("x,y\n0,1\n", "results.csv"),
        ("time  x\n0  1\n", "results.csv"),
        ("", "results.csv"),
    ],
)
@pytest.mark.usefixtures("stored")
def test_a_faulty_table_is_refused_with_the_place_and_leaves_nothing(tmp_path: Path, text: str, place: str) -> None:
    path = tmp_path / "results.csv"
    path.write_text(text)
    with pytest.raises(InputError) as refused:
        open_rows(path, ColumnTypes())
    assert place in str(refused.value)
    assert [p.name for p in tmp_path.rglob("*") if p.is_file()] == ["results.csv"]


LARGE = [2**53 + 1, 2**63, 2**64 - 1]  # more digits than a double has


def with_texts(path: Path, rows: int) -> Results:
    """A table of a run with 64-bit integers, texts and binary data."""
    exact = {
        "fmu.id": [LARGE[k % 3] for k in range(rows)],
        "fmu.count": [-k for k in range(rows)],
        "fmu.mode": ["idle"] * (rows - 2) + ["run, fast", ""],
        "fmu.word": ["42"] * rows,
        "fmu.raw": [bytes([255, k % 7]) for k in range(rows)],
    }
    results = Results(np.arange(rows) * 0.1, ("fmu.x",), np.ones((rows, 1)), {"fmu.x": "m"}, exact)
    results.write(path)
    return results


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".hdf5"])
@pytest.mark.usefixtures("stored")
def test_integers_of_64_bits_are_numbers_and_texts_and_texts_are_texts(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"results{suffix}"
    results = with_texts(path, 300)
    texts, words = results.texts(), frozenset({"fmu.word", "fmu.raw", "fmu.mode"})
    rows = open_rows(path, ColumnTypes(text=[*results.exact], words=words))
    assert {*rows.units} == {"fmu.x", "fmu.id", "fmu.count"}
    assert {*rows.texts} == {*texts}
    assert rows.rounded == ["fmu.id"]
    np.testing.assert_array_equal(rows.read("fmu.id"), [float(LARGE[k % 3]) for k in range(300)])
    np.testing.assert_array_equal(rows.read("fmu.count"), -np.arange(300))
    for name, row in ((name, row) for name in texts for row in (0, 150, 298, 299)):
        assert rows.text(name, row) == texts[name][row]


def test_large_integers_of_another_tool_are_exact_in_memory_and_said_to_be_inexact_in_files(
    tmp_path: Path, stored: bool
) -> None:
    path = tmp_path / "foreign.csv"
    path.write_text(f"time,id,count,x\n0,{2**53 + 1},1,1e20\n1,{2**53 + 3},2,2.5\n")
    assert open_rows(path, ColumnTypes()).inexact == (["id"] if stored else [])


# -- runs ----------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two runs of a tank, of which the manifest of the second has been cut off, and one that has no rows."""
    monkeypatch.chdir(tmp_path)
    for k, name in enumerate(("tank/runs/0001", "tank", "half")):
        run = tmp_path / "results" / name
        run.mkdir(parents=True, exist_ok=True)
        manifest = json.dumps({"scenario": {"name": "tank", "components": {}}, "units": {"tank.level": "m"}})
        (run / "manifest.json").write_text(manifest[: 20 if name == "tank" else None])
        rows = "time,tank.level,tank.Level\n0,1,5\n1,2,6\n" if name != "half" else "time,x\n0\n"
        (run / "results.csv").write_text(rows)
        os.utime(run / "manifest.json", (1e9 + k, 1e9 + k))
    return tmp_path


def test_runs_without_names_are_all_that_can_be_read(folder: Path) -> None:
    places, notes = find_runs((), Path("results"))
    runs, warnings = open_runs(places, lambda words: nullcontext())
    assert notes == []
    assert [run.place.name for run in runs] == ["tank/runs/0001", "tank"]
    assert len(warnings) == 2  # the torn manifest of tank, and half is left out
    assert runs[0].rows.units == {"tank.level": "m", "tank.Level": ""}  # names that differ in case only
    assert runs[1].rows.units == {"tank.level": "", "tank.Level": ""}


@pytest.mark.parametrize(
    "words",
    [
        "nothing",
        "9",
        "half",
        ".",
        "text.txt",
        "--layout wrong.json",
        "--results empty",
        "tank --port 70000",
        "tank -p {port}",
    ],
)
def test_bad_input_ends_with_code_2_and_leaves_all_as_it_is(folder: Path, words: str) -> None:
    (folder / "text.txt").write_text("words\n")
    (folder / "wrong.json").write_text('{"layouts": []}')
    entries()  # which gives the results their numbers
    before = sorted(folder.rglob("*"))
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        words = words.replace("-p {port}", f"--port {taken.getsockname()[1]}")
        prepare = [] if "--port" in words else ["--prepare"]
        done = CliRunner().invoke(command_line(), ["view", *words.split(), "--no-browser", *prepare])
    assert (done.exception.exit_code if isinstance(done.exception, InputError) else done.exit_code) == 2
    assert sorted(folder.rglob("*")) == before


# -- the server ----------------------------------------------------------------------------------------


@pytest.fixture
def page(tmp_path: Path) -> Iterator[tuple[ServedPage, Ask]]:
    """The page of two runs, and a function for requests."""
    runs = []
    for k in range(2):
        file = tmp_path / f"r{k}.csv"
        file.write_text(f"time,x [m],y\n0,{k},1\n1,{k + 1},\n1,{k + 2},3\n")
        runs.append(ViewedRun(RunPlace(f"r{k}", f"run {k}", file)))
    with view_page("2 runs", runs, Layouts(tmp_path / "view.json")) as made:
        yield made, asking(made)


def asking(page: ServedPage) -> Ask:
    """A function that sends a request to a page and returns the answer."""

    def ask(path: str, content: Any = None) -> Any:
        data = None if content is None else json.dumps(content).encode()
        request = urllib.request.Request(page.url + path, data, {"Content-Type": "application/json"})
        with urllib.request.urlopen(request, timeout=10) as answer:
            body = answer.read()
            return body if "json" not in answer.headers["Content-Type"] else json.loads(body)

    return ask


def refusal(ask: Ask, path: str, content: Any = None) -> str:
    """The reason why a request is refused."""
    with pytest.raises(HTTPError, match="400") as refused:
        ask(path, content)
    return str(json.loads(refused.value.read())["error"])


def values_at(ask: Ask, at: float, *curves: list[Any]) -> list[float]:
    """Values of curves at a time."""
    found: list[float] = np.frombuffer(ask("values", {"at": at, "curves": curves}))[1::2].tolist()
    return found


def test_points_values_planes_and_tables_come_from_the_server(page: tuple[ServedPage, Ask]) -> None:
    _, ask = page
    about = ask("about")
    assert [(run["name"], run["set"], run["rows"]) for run in about["runs"]] == [("r0", 0, 3), ("r1", 0, 3)]
    assert about["sets"] == [[["x", "y"], ["m", ""], []]]
    span = {"from": 0.0, "to": 1.0}
    points = np.frombuffer(ask("points", {**span, "width": 100, "curves": [[0, "x"], [1, "y"], [0, "y"]]}))
    first, other, again = [3, 1, 1, 0, 1, 1, 0, 1, 2], [3, 1, 1, 0, 1, 1, 1, np.nan, 3], [3, 1, 0, 1, np.nan, 3]
    np.testing.assert_array_equal(points, [*first, *other, *again])
    plane = np.frombuffer(ask("plane", {**span, "width": 100, "across": [[0, "x"]], "curves": [[0, "y"]]}))
    np.testing.assert_array_equal(plane, [3, 1, 0, 1, 1, 0, 1, 2, 1, np.nan, 3])
    assert values_at(ask, 1.0, [0, "x"], [1, "x"]) == [2, 3]
    of = urlencode({"of": json.dumps({**span, "curves": [[0, "x"], [1, "y"]]})})
    text = ask(f"export.csv?{of}").decode()
    assert text == "time,run 0: x [m],run 1: y\n0.0,0.0,1.0\n1.0,1.0,\n1.0,2.0,3.0\n"
    until = time.monotonic() + 10
    while [*process_folder().glob("view-*.csv")]:  # removed after its last byte was sent
        assert time.monotonic() < until
        time.sleep(0.01)


def test_a_derived_signal_is_a_signal_of_its_run_and_never_derived_from_itself(page: tuple[ServedPage, Ask]) -> None:
    _, ask = page
    of = {"a": [1, "x"], "b": [0, "x"]}
    for formula, stated, unit in (("a", "", "m"), (" b", "mm", "mm"), ("a - b", "m", "m"), ("a - b", "", "")):
        (made,) = ask("derive", {"name": "d", "formula": formula, "of": of, "unit": stated})
        assert made["unit"] == unit
    assert values_at(ask, 0.0, [1, "d"]) == [1]
    assert ask("about")["runs"][1]["derived"] == [made]
    wrong = [("x", "a", {"a": [0, "x"]}), ("e", "a", {"a": [0, "z"]}), ("e", "q", {"a": [0, "x"]})]
    for name, formula, signals in wrong:
        refusal(ask, "derive", {"name": name, "formula": formula, "of": signals})
    ask("derive", {"name": "e", "formula": "2 * a", "of": {"a": [1, "d"]}})
    assert "d ← e ← d" in refusal(ask, "derive", {"name": "d", "formula": "a", "of": {"a": [1, "e"]}})
    made = ask("derive", {"name": "d", "formula": "3 * a", "of": {"a": [1, "x"]}})
    assert [each["name"] for each in made] == ["d", "e"]  # also what depends on it
    assert values_at(ask, 1.0, [1, "d"], [1, "e"]) == [9, 18]
    refusal(ask, "derive", {"name": "d", "formula": "q", "of": {"a": [1, "x"]}})
    assert values_at(ask, 1.0, [1, "d"], [1, "e"]) == [9, 18]
    refusal(ask, "derive", {"remove": [1, "d"]})  # e is derived from it
    refusal(ask, "derive", {"remove": [1, "x"]})
    for name in ("e", "d"):
        assert ask("derive", {"remove": [1, name]}) == []
    assert ask("about")["runs"][1]["derived"] == []


@pytest.mark.parametrize(
    ("path", "content"),
    [
        ("points", []),
        ("points", {"from": 1, "to": 1, "width": 10, "curves": []}),
        ("points", {"from": 0, "to": 1, "width": 10**9, "curves": []}),
        ("points", {"from": 0, "to": 1, "width": 10, "curves": [[7, "x"]]}),
        ("plane", {"from": 0, "to": 1, "width": 10, "curves": [[0, "x"]], "across": [[1, "x"]]}),
        ("values", {"at": "now", "curves": []}),
        ("values", b'{"at": 1e999, "curves": [[0, "x"]]}'),
        ("points", b'{"from": 0, "to": 1' + b"0" * 400 + b', "width": 9, "curves": [[0, "x"]]}'),
        ("layouts", {"name": "", "layout": {}}),
        ("layouts", {"file": "x.json", "content": {"schema_version": 2, "layouts": {}}}),
        ("export.csv?of=nothing", None),
    ],
)
def test_a_wrong_request_is_refused_and_the_page_stays(page: tuple[ServedPage, Ask], path: str, content: Any) -> None:
    made, ask = page
    if isinstance(content, bytes):
        request = urllib.request.Request(made.url + path, content, {"Content-Type": "application/json"})
        with pytest.raises(HTTPError, match="400"):
            urllib.request.urlopen(request, timeout=10)
    else:
        refusal(ask, path, content)
    assert ask("about")["runs"]


def test_names_with_control_characters_are_shown_as_escapes(tmp_path: Path) -> None:
    file = tmp_path / "r.csv"
    file.write_text("time,x\x1b[31m\u202e [m]\n0,1\n1,2\n")
    with view_page("run", [ViewedRun(RunPlace("\udfff", "r\x1b", file))], Layouts(tmp_path / "view.json")) as page:
        ask = asking(page)
        about = ask("about")
        assert about["runs"][0]["label"] == r"r\u001b"
        ((name,), units, _) = about["sets"][0]
        assert (name, units) == (r"x\u001b[31m\u202e", ["m"])
        assert values_at(ask, 1.0, [0, name]) == [2.0]


def test_texts_come_at_the_cursor_and_in_exports(tmp_path: Path) -> None:
    file = tmp_path / "results.csv"
    results = with_texts(file, 4)
    rows = open_rows(file, ColumnTypes(text=[*results.exact], words=frozenset({"fmu.word", "fmu.raw"})))
    with view_page(
        "run 0", [ViewedRun(RunPlace("r0", "run 0", file), rows=rows)], Layouts(tmp_path / "v.json")
    ) as page:
        ask = asking(page)
        names = [[0, name] for name in ("fmu.id", "fmu.mode", "fmu.raw")]
        assert ask("texts", {"at": 0.25, "curves": names}) == [str(2**64 - 1), "run, fast", "ff02"]
        assert ask("texts", {"at": -1.0, "curves": names}) == [None, None, None]
        refusal(ask, "points", {"from": 0, "to": 1, "width": 9, "curves": [[0, "fmu.mode"]]})
        of = urlencode({"of": json.dumps({"from": 0.15, "to": 0.25, "curves": [[0, "fmu.x"], *names]})})
        assert ask(f"export.csv?{of}").decode().splitlines()[1:] == ['0.2,1.0,18446744073709551615,"run, fast",ff02']
        refusal(ask, "derive", {"name": "fmu.raw", "formula": "a", "of": {"a": [0, "fmu.x"]}})


@pytest.mark.parametrize(
    ("layout", "place"),
    [
        ({"plots": 3}, "layouts.one.plots"),
        ({}, "layouts.one.plots"),
        ({"plots": [{"kind": "pie", "axes": []}]}, "layouts.one.plots.0.kind"),
        ({"plots": [{"axes": [{"curves": [{"run": "r0"}]}]}]}, "curves.0.name"),
        ({"plots": [{"axes": [{"curves": []}] * 5}]}, "layouts.one.plots.0.axes"),
        ({"plots": [], "view": {"from": float("nan"), "to": 1}}, "view.from"),
        ({"plots": [], "derived": [{"name": "d", "formula": "a", "of": {}}]}, "derived.0.of"),
    ],
)
def test_layouts_are_kept_in_a_file_and_one_that_is_none_is_refused_by_its_place(
    page: tuple[ServedPage, Ask], tmp_path: Path, layout: Any, place: str
) -> None:
    _, ask = page
    assert ask("layouts", {"name": "good", "layout": {"plots": []}}) == {"good": {"plots": []}}
    before = (tmp_path / "view.json").read_bytes()
    content = {"schema_version": 1, "layouts": {"one": layout}}
    assert place in refusal(ask, "layouts", {"name": "one", "layout": layout})
    assert place in refusal(ask, "layouts", {"file": "of a colleague.json", "content": content})
    assert (tmp_path / "view.json").read_bytes() == before
    (tmp_path / "wrong.json").write_text(json.dumps(content))
    with pytest.raises(InputError) as refused:
        Layouts(tmp_path / "wrong.json")
    assert place in str(refused.value)
    assert ask("layouts", {"name": "good", "layout": None}) == {}


def test_a_run_that_grows_is_followed_and_one_that_is_removed_is_told(
    page: tuple[ServedPage, Ask], tmp_path: Path
) -> None:
    made, ask = page
    ask("derive", {"name": "d", "formula": "2 * a", "of": {"a": [1, "x"]}})
    with (tmp_path / "r1.csv").open("a") as stream:
        stream.write("2,7,8\n")
    (tmp_path / "r0.csv").unlink()
    until = time.monotonic() + 20
    while made.state()["spans"][1] != [4, 0.0, 2.0] or len(made.state()["lost"]) < 1:
        assert time.monotonic() < until, made.state()
        time.sleep(0.1)
    assert values_at(ask, 5.0, [1, "x"], [1, "d"]) == [7.0, 14.0]
    points = np.frombuffer(ask("points", {"from": 0, "to": 1, "width": 9, "curves": [[0, "x"], [1, "x"]]}))
    assert (points[0], points[2]) == (-1, 4)


def test_a_run_under_way_is_followed_to_its_end(tmp_path: Path) -> None:
    signals = {"x": {"changes": [{"at": 0.5, "to": 1}]}}
    scenario = {
        "name": "s",
        "duration": 3,
        "step": 0.02,
        "components": {"r": {"block": "reference", "signals": signals}},
    }
    (tmp_path / "s.yaml").write_text(json.dumps(scenario))
    command = [sys.executable, "-m", "cosim", "run", "s.yaml", "--pace", "1", "--no-report", "--out", "out"]
    run, until = None, time.monotonic() + 60
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as running:
        while run is None or not run.rows.rows:
            assert time.monotonic() < until
            with suppress(InputError):  # until it has begun
                places, _ = find_runs([str(tmp_path / "out")], tmp_path)
                (run,), _ = open_runs(places, lambda text: nullcontext())
        assert run.rows.rows < 151
        assert running.wait(60) == 0
    while run.rows.rows < 151:
        assert time.monotonic() < until
        assert run.check()
        run.follow()
    assert (run.rows.read("r.x")[-1], run.rows.read(TIME)[-1], run.lost) == (1.0, 3.0, "")
