"""The signal browser without a browser: extremes of blocks, caches, derived signals, its server, bad input."""

from __future__ import annotations

import json
import os
import socket
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.parse import urlencode

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from typer.testing import CliRunner

from cosim.base.errors import InputError
from cosim.base.scratch import LOCK, process_folder
from cosim.history.entries import entries
from cosim.storage.results import Results, read_results
from cosim.verbs.cli import app
from cosim.viewing import stored_rows, view_page
from cosim.viewing.layouts import Layouts
from cosim.viewing.pyramid import TIME, Recording, level_sizes
from cosim.viewing.stored_rows import ColumnTypes, StoredRecording, open_rows
from cosim.viewing.view_page import ViewPage
from cosim.viewing.viewed_runs import RunPlace, ViewedRun, file_state, find_runs, open_runs

RNG = np.random.default_rng
Array = np.ndarray[Any, np.dtype[np.float64]]


def _recording(time: Array, **signals: Array) -> Recording:
    return Recording({TIME: time, **signals}, dict.fromkeys(signals, "m"), time.size)


def _times(kind: str, rows: int) -> Array:
    """Uniform times, bursts with long pauses, or events: many rows of one time."""
    rng = RNG(rows)
    steps = {
        "uniform": np.full(rows, 1e-3),
        "bursts": np.where(rng.random(rows) < 0.001, 50.0, 1e-4),
        "events": np.where(rng.random(rows) < 0.5, 0.0, 1e-2),
    }[kind]
    return np.cumsum(steps)


# -- pictures ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["uniform", "bursts", "events"])
@pytest.mark.parametrize("rows", [1, 17, 5000, 300_000])
def test_a_picture_has_the_extremes_of_the_rows_in_every_pixel_column(kind: str, rows: int) -> None:
    time, rng = _times(kind, rows), RNG(1)
    values = rng.standard_normal(rows)
    values[rng.random(rows) < 0.2] = np.nan
    values[rows // 3 : rows // 2] = np.nan
    recording, width = _recording(time, x=values), 200
    for begin, end in ((time[0], time[-1] + 1e-9), (time[rows // 4], time[rows // 2] + 1e-3)):
        picture = recording.picture(begin, end, width)
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


def test_uniform_columns_are_exact_to_a_quarter_of_a_column() -> None:
    time, width = np.arange(400_000) * 1e-3, 100
    values = RNG(2).standard_normal(time.size)
    picture = _recording(time, x=values).picture(0.0, 400.0, width)
    low, high = picture.points("x")
    for k in range(width):
        rows = values[4000 * k + 1000 : 4000 * k + 3000]  # the inner half of a column
        assert low[k] <= rows.min()
        assert high[k] >= rows.max()
        wide = values[max(0, 4000 * k - 1000) : 4000 * k + 5000]
        assert low[k] >= wide.min()
        assert high[k] <= wide.max()


def test_a_wide_gap_is_a_gap_and_a_pause_between_bursts_is_no_block() -> None:
    time = np.concatenate([np.arange(50_000) * 1e-3, 1000.0 + np.arange(50_000) * 1e-3])
    values = np.sin(time)
    values[20_000:30_000] = np.nan
    picture = _recording(time, x=values).picture(0.0, 1050.0, 500)
    low, _ = picture.points("x")
    pause = (picture.time > 52.0) & (picture.time < 998.0)
    assert not pause.any()
    near = _recording(time, x=values).picture(0.0, 50.0, 500)
    inside = (near.time > 20.2) & (near.time < 29.8)
    assert np.isnan(near.points("x")[0][inside]).all()
    assert np.isfinite(near.points("x")[0][~inside]).mean() > 0.98
    assert low.size < 600


@given(
    arrays.arrays(np.float64, st.integers(1, 600), elements=st.sampled_from([0.0, 0.0, 0.5, 1.0])),
    st.floats(-1.0, 300.0),
)
@settings(max_examples=60, deadline=None)
def test_a_time_is_located_as_by_numpy(steps: Array, at: float) -> None:
    time = np.cumsum(steps)
    recording = _recording(time)
    assert recording.locate(at) == np.searchsorted(time, at)
    assert recording.locate(at, "right") == np.searchsorted(time, at, "right")


def test_levels_halve_by_sixteen_down_to_a_few_blocks() -> None:
    assert level_sizes(10_000_000) == [10_000_000, 625_000, 39_063, 2_442, 153]
    assert level_sizes(3) == [3, 1]


# -- caches --------------------------------------------------------------------------------------------


def _table(path: Path, rows: int = 30_000, more: str = "") -> Results:
    rng = RNG(3)
    values = np.cumsum(rng.standard_normal((rows, 3)), axis=0)
    values[100:5000, 1] = np.nan
    time = np.cumsum(np.where(rng.random(rows) < 0.1, 0.0, 1e-3))
    results = Results(time, ("a.x", "a", "A"), values, {"a.x": "m", "a": "", "A": "N"})
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as stream:
        stream.write("time,a.x [m],a,A [N],word\n")
        stream.writelines(
            f"{t!r},{','.join('' if np.isnan(v) else repr(v) for v in row)},on{more}\n"
            for t, row in zip(time.tolist(), values.tolist(), strict=True)
        )
    return results


@pytest.fixture
def always_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    """Convert small tables too, in small row groups."""
    pytest.importorskip("pyarrow")
    monkeypatch.setattr(stored_rows, "SMALL", 0)
    monkeypatch.setattr(stored_rows, "GROUP_VALUES", 4 * 4096)


@pytest.mark.usefixtures("always_stored")
@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".mat"])
def test_a_converted_table_gives_what_memory_gives(tmp_path: Path, suffix: str) -> None:
    results, path = _table(tmp_path / "results.csv"), tmp_path / f"results{suffix}"
    if suffix != ".csv":
        results.write(path)
    seen: list[tuple[int, int]] = []
    stored = open_rows(path, ColumnTypes(), lambda done, total: seen.append((done, total)))
    assert isinstance(stored, StoredRecording)
    assert seen
    assert all(done <= total for done, total in seen)
    assert stored.units == {"a.x": "m", "a": "", "A": "N"}
    columns = {TIME: results.time, **{name: results[name] for name in results.columns}}
    memory = Recording(columns, stored.units, stored.rows)
    assert stored.span() == memory.span()
    for name in results.columns:
        np.testing.assert_array_equal(stored.read(name), results[name])
        for begin, end in ((0.0, 27.0), (3.0, 9.0), (5.0, 5.1)):
            ours, theirs = (each.picture(begin, end, 100) for each in (stored, memory))
            np.testing.assert_array_equal(ours.time, theirs.time)
            np.testing.assert_array_equal(ours.points(name), theirs.points(name))
    places = np.array([5, 29_000, 4097, 4096])
    np.testing.assert_array_equal(stored.take("rows", "a.x", places), results["a.x"][places])
    again = open_rows(path, ColumnTypes(), lambda done, total: pytest.fail("converted twice"))
    assert again.rows == stored.rows


@pytest.mark.usefixtures("always_stored")
def test_a_changed_table_is_converted_again_and_drafts_and_old_conversions_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path, cache = tmp_path / "run" / "results.csv", tmp_path / "cache" / "cosim" / "view"
    _table(path, 5000)
    assert open_rows(path, ColumnTypes()).rows == 5000
    (first,) = cache.iterdir()
    killed = cache / "draft-killed"  # as a killed command leaves it
    killed.mkdir()
    (killed / LOCK).touch()
    _table(path, 6000)
    os.utime(first, (0.0, 0.0))
    assert open_rows(path, ColumnTypes()).rows == 6000
    (second,) = cache.iterdir()
    assert second not in {first, killed}
    assert [p.name for p in path.parent.iterdir()] == ["results.csv"]


@pytest.mark.usefixtures("always_stored")
@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time,x\n0,1\n1,2\n0.5,3\n", "results.csv:4"),
        ("time,x\n0,1\n1\n", "results.csv:3"),
        ("time,x\n0,1\n,2\n", "results.csv:3"),
        ("time,x\n", "has no row yet"),
        ("x,y\n0,1\n", "time"),
        ("time;x\n0;1\n", "semicolons"),
        ("", "is empty"),
    ],
)
def test_a_faulty_table_is_refused_with_the_place_and_leaves_nothing(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "results.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        open_rows(path, ColumnTypes())
    assert [p.name for p in tmp_path.rglob("*") if p.is_file()] == ["results.csv"]


LARGE = [2**53 + 1, 2**63, 2**64 - 1]  # more digits than a double has


def _with_texts(path: Path, rows: int) -> Results:
    """A table of a run with 64-bit integers, texts and binary data."""
    exact = {
        "fmu.id": [LARGE[k % 3] for k in range(rows)],
        "fmu.count": [-k for k in range(rows)],
        "fmu.mode": ["idle", "run, fast", ""][:1] * (rows - 2) + ["run, fast", ""],
        "fmu.raw": [bytes([255, k % 7]) for k in range(rows)],
    }
    results = Results(np.arange(rows) * 0.1, ("fmu.x",), np.ones((rows, 1)), {"fmu.x": "m"}, exact)
    results.write(path)
    return results


def _same_texts(recording: Recording, results: Results, rows: int) -> None:
    texts = results.texts()
    assert {*recording.units} == {"fmu.x", "fmu.id", "fmu.count"}
    assert {*recording.texts} == {*texts}
    assert recording.rounded == ["fmu.id"]
    np.testing.assert_array_equal(recording.read("fmu.id"), [float(LARGE[k % 3]) for k in range(rows)])
    np.testing.assert_array_equal(recording.read("fmu.count"), -np.arange(rows))
    for name, row in ((name, row) for name in texts for row in (0, rows // 2, rows - 2, rows - 1)):
        assert recording.text(name, row) == texts[name][row]


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".hdf5"])
def test_integers_of_64_bits_are_numbers_and_texts_and_texts_are_texts(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"results{suffix}"
    if suffix == ".hdf5":
        pytest.importorskip("h5py")
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    results = _with_texts(path, 300)
    _same_texts(open_rows(path, ColumnTypes(text=[*results.exact])), results, 300)


@pytest.mark.usefixtures("always_stored")
@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".hdf5"])
def test_a_converted_table_keeps_texts_and_integers(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"results{suffix}"
    if suffix == ".hdf5":
        pytest.importorskip("h5py")
    monkeypatch.setattr(stored_rows, "TEXT_ROWS", 64)  # several groups
    results = _with_texts(path, 300)
    stored = open_rows(path, ColumnTypes(text=[*results.exact]))
    assert isinstance(stored, StoredRecording)
    _same_texts(stored, results, 300)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@pytest.mark.parametrize("is_stored", [False, True])
def test_texts_that_look_like_integers_are_texts_if_that_is_known(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch, *, is_stored: bool
) -> None:
    monkeypatch.setattr(stored_rows, "SMALL", 0 if is_stored else stored_rows.SMALL)
    pytest.importorskip("pyarrow")
    path = tmp_path / f"results{suffix}"
    exact = {"fmu.id": [LARGE[k % 2] for k in range(30)], "fmu.word": ["42"] * 30, "fmu.raw": [b"\x12"] * 30}
    Results(np.arange(30.0), ("fmu.x",), np.ones((30, 1)), exact=exact).write(path)
    known = frozenset({"fmu.word", "fmu.raw"}) if suffix == ".csv" else frozenset[str]()
    recording = open_rows(path, ColumnTypes(text=[*exact], words=known))
    assert {*recording.units} == {"fmu.x", "fmu.id"}
    assert {*recording.texts} == {*exact}
    assert recording.text("fmu.word", 3) == "42"


@pytest.mark.parametrize("is_stored", [False, True])
def test_large_integers_of_another_tool_are_exact_in_a_small_table_and_said_to_be_inexact_in_a_stored_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, is_stored: bool
) -> None:
    monkeypatch.setattr(stored_rows, "SMALL", 0 if is_stored else stored_rows.SMALL)
    pytest.importorskip("pyarrow")
    path = tmp_path / "foreign.csv"
    path.write_text(f"time,id,count,x\n0,{2**53 + 1},1,1e20\n1,{2**53 + 3},2,2.5\n")
    assert open_rows(path, ColumnTypes()).inexact == (["id"] if is_stored else [])


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
        (run / "results.csv").write_text(
            "time,tank.level,tank.Level\n0,1,5\n1,2,6\n" if name != "half" else "time,x\n0\n"
        )
        os.utime(run / "manifest.json", (1e9 + k, 1e9 + k))
    return tmp_path


def _no_bar(words: str) -> Any:
    from contextlib import nullcontext

    return nullcontext()


def test_runs_without_names_are_all_that_can_be_read(folder: Path) -> None:
    places, notes = find_runs((), Path("results"))
    runs, warnings = open_runs(places, _no_bar)
    assert notes == []
    assert [run.place.name for run in runs] == ["tank/runs/0001", "tank"]
    assert len(warnings) == 2  # the torn manifest of tank
    assert runs[0].rows.units == {"tank.level": "m", "tank.Level": ""}  # names that differ in case only
    assert runs[1].rows.units == {"tank.level": "", "tank.Level": ""}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("nothing", "no such folder or file"),
        ("9", "no results with the number 9; `cosim list` shows the numbers, up to"),
        ("half", "results.csv:2"),
        (".", "has no rows to draw"),
        ("text.txt", "is a text"),
        ("--layout wrong.json", "no file of layouts"),
        ("--results empty", "holds no results"),
        ("tank --port 70000", "--port"),
    ],
)
def test_bad_input_ends_with_code_2_and_the_reason(folder: Path, words: str, message: str) -> None:
    (folder / "text.txt").write_text("words\n")
    (folder / "wrong.json").write_text('{"layouts": []}')
    entries()  # which gives the results their numbers
    before = sorted(folder.rglob("*"))
    done = CliRunner().invoke(app, ["view", *words.split(), "--no-browser", "--prepare"])
    assert message in (str(done.exception) if isinstance(done.exception, InputError) else done.output)
    assert (done.exception.exit_code if isinstance(done.exception, InputError) else done.exit_code) == 2
    assert sorted(folder.rglob("*")) == before


def test_a_port_in_use_ends_with_code_2(folder: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        done = CliRunner().invoke(app, ["view", "tank", "--no-browser", "--port", str(taken.getsockname()[1])])
    assert isinstance(done.exception, InputError)


def test_prepared_runs_are_told(folder: Path) -> None:
    done = CliRunner().invoke(app, ["view", "tank*", "--prepare", "--json"])
    assert [run["name"] for run in json.loads(done.stdout)["runs"]] == ["tank/runs/0001", "tank"]
    named = CliRunner().invoke(app, ["view", "results/tank", "2", "tank", "--prepare"])
    assert "1 run, 2 signals, 2 rows: run 2 (tank)" in named.stdout


# -- the server ----------------------------------------------------------------------------------------


Ask = Callable[..., Any]


@pytest.fixture
def page(tmp_path: Path) -> Iterator[tuple[ViewPage, Ask]]:
    """The page of two runs, and a function for requests."""
    runs = []
    for k in range(2):
        file = tmp_path / f"r{k}.csv"
        file.write_text(f"time,x [m],y\n0,{k},1\n1,{k + 1},\n1,{k + 2},3\n")
        runs.append(ViewedRun(RunPlace(f"r{k}", f"run {k}", file), open_rows(file, ColumnTypes()), file_state(file)))
    with ViewPage("2 runs", runs, Layouts(tmp_path / "view.json")) as made:
        yield made, _asking(made)


def _asking(page: ViewPage) -> Ask:
    """A function that sends a request to a page and returns the answer."""

    def ask(path: str, content: Any = None) -> Any:
        data = None if content is None else json.dumps(content).encode()
        request = urllib.request.Request(page.server.url + path, data, {"Content-Type": "application/json"})
        with urllib.request.urlopen(request, timeout=10) as answer:
            body = answer.read()
            return body if "json" not in answer.headers["Content-Type"] else json.loads(body)

    return ask


def test_points_values_planes_and_tables_come_from_the_server(page: tuple[ViewPage, Ask]) -> None:
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
    values = np.frombuffer(ask("values", {"at": 1.0, "curves": [[0, "x"], [1, "x"]]}))
    np.testing.assert_array_equal(values, [1, 2, 1, 3])
    of = urlencode({"of": json.dumps({**span, "curves": [[0, "x"], [1, "y"]]})})
    text = ask(f"export.csv?{of}").decode()
    assert text == "time,run 0: x [m],run 1: y\n0.0,0.0,1.0\n1.0,1.0,\n1.0,2.0,3.0\n"


def test_a_derived_signal_is_a_signal_of_its_run(page: tuple[ViewPage, Ask], tmp_path: Path) -> None:
    _, ask = page
    of = {"a": [1, "x"], "b": [0, "x"]}
    for formula, stated, unit in (("a", "", "m"), ("a - b", "", ""), (" b", "mm", "mm"), ("a - b", "m", "m")):
        (made,) = ask("derive", {"name": "d", "formula": formula, "of": of, "unit": stated})
        assert made["unit"] == unit
    values = np.frombuffer(ask("values", {"at": 0.0, "curves": [[1, "d"]]}))
    np.testing.assert_array_equal(values, [0, 1])
    assert ask("about")["runs"][1]["derived"] == [made]
    for wrong in (
        {"name": "x", "formula": "a", "of": {"a": [0, "x"]}},
        {"name": "e", "formula": "a", "of": {"a": [0, "z"]}},
        {"name": "e", "formula": "a", "of": {}},
    ):
        with pytest.raises(HTTPError, match="400"):
            ask("derive", wrong)


def _refusal(ask: Ask, path: str, content: Any) -> str:
    """The reason why a request is refused."""
    with pytest.raises(HTTPError, match="400") as refused:
        ask(path, content)
    return str(json.loads(refused.value.read())["error"])


def test_a_derived_signal_is_never_derived_from_itself(page: tuple[ViewPage, Ask]) -> None:
    _, ask = page
    ask("derive", {"name": "d", "formula": "a + 1", "of": {"a": [0, "x"]}})
    ask("derive", {"name": "e", "formula": "2 * a", "of": {"a": [0, "d"]}})
    own = {"name": "d", "formula": "a + 1", "of": {"a": [0, "d"]}}
    for _ in range(2):
        assert "d ← d" in _refusal(ask, "derive", own)
    assert "d ← e ← d" in _refusal(ask, "derive", {**own, "of": {"a": [0, "e"]}})
    np.testing.assert_array_equal(np.frombuffer(ask("values", {"at": 0.0, "curves": [[0, "d"]]})), [0, 1])


def test_a_derived_signal_is_removed_after_those_that_depend_on_it(page: tuple[ViewPage, Ask]) -> None:
    _, ask = page
    ask("derive", {"name": "d", "formula": "a", "of": {"a": [0, "x"]}})
    ask("derive", {"name": "e", "formula": "a", "of": {"a": [0, "d"]}})
    assert "e is derived from d" in _refusal(ask, "derive", {"remove": [0, "d"]})
    assert "no derived signal" in _refusal(ask, "derive", {"remove": [0, "x"]})
    for name in ("e", "d"):
        assert ask("derive", {"remove": [0, name]}) == []
    assert ask("about")["runs"][0]["derived"] == []
    _refusal(ask, "values", {"at": 0.0, "curves": [[0, "d"]]})


def test_a_changed_formula_changes_the_signals_that_depend_on_it_or_nothing(page: tuple[ViewPage, Ask]) -> None:
    _, ask = page
    ask("derive", {"name": "d", "formula": "a", "of": {"a": [0, "x"]}})
    ask("derive", {"name": "e", "formula": "a + b", "of": {"a": [0, "d"], "b": [0, "x"]}})
    made = ask("derive", {"name": "d", "formula": "3 * a", "of": {"a": [0, "x"]}})
    assert [each["name"] for each in made] == ["d", "e"]
    at_end = {"at": 1.0, "curves": [[0, "d"], [0, "e"]]}
    np.testing.assert_array_equal(np.frombuffer(ask("values", at_end)), [1, 6, 1, 8])
    _refusal(ask, "derive", {"name": "d", "formula": "q", "of": {"a": [0, "x"]}})
    np.testing.assert_array_equal(np.frombuffer(ask("values", at_end)), [1, 6, 1, 8])


@pytest.mark.parametrize(
    ("path", "content"),
    [
        ("points", []),
        ("points", {"from": 0, "to": 1, "width": 10}),
        ("points", {"from": 1, "to": 1, "width": 10, "curves": []}),
        ("points", {"from": 0, "to": 1, "width": 10**9, "curves": []}),
        ("points", {"from": 0, "to": 1, "width": 10, "curves": [[7, "x"]]}),
        ("points", {"from": 0, "to": 1, "width": 10, "curves": [[-1, "x"]]}),
        ("plane", {"from": 0, "to": 1, "width": 10, "curves": [[0, "x"]], "across": [[1, "x"]]}),
        ("values", {"at": "now", "curves": []}),
        ("layouts", {"name": "", "layout": {}}),
        ("layouts", {"name": "a", "layout": 3}),
        ("export.csv?of=nothing", None),
    ],
)
def test_a_wrong_request_is_refused_and_the_page_stays(page: tuple[ViewPage, Ask], path: str, content: Any) -> None:
    _, ask = page
    with pytest.raises(HTTPError, match="400"):
        ask(path, content)
    assert ask("about")["runs"]


def test_an_export_that_is_too_large_asks_for_a_zoom(
    page: tuple[ViewPage, Ask], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view_page, "MOST_CELLS", 5)
    of = urlencode({"of": json.dumps({"from": 0, "to": 1, "curves": [[0, "x"], [1, "x"]]})})
    with pytest.raises(HTTPError, match="400") as refused:
        page[1](f"export.csv?{of}")
    assert "zoom in" in json.loads(refused.value.read())["error"]


def test_an_export_leaves_no_file(page: tuple[ViewPage, Ask]) -> None:
    of = urlencode({"of": json.dumps({"from": 0, "to": 1, "curves": [[0, "x"]]})})
    assert page[1](f"export.csv?{of}")
    until = time.monotonic() + 10
    while [*process_folder().glob("view-*.csv")]:  # removed after its last byte was sent
        assert time.monotonic() < until
        time.sleep(0.01)


def test_signals_in_a_chain_are_derived_in_time_and_a_circle_is_refused(page: tuple[ViewPage, Ask]) -> None:
    _, ask = page
    before = "x"
    for k in range(40):  # 2^40 ways from the last signal to the first
        ask("derive", {"name": f"d{k}", "formula": "(a + b) / 2", "of": {"a": [0, before], "b": [0, before]}})
        before = f"d{k}"
    assert len(ask("derive", {"name": "d0", "formula": "2 * a", "of": {"a": [0, "x"]}})) == 40
    with pytest.raises(HTTPError, match="400") as refused:
        ask("derive", {"name": "d0", "formula": "a", "of": {"a": [0, "d2"]}})
    assert "d0 ← d2 ← d1 ← d0" in json.loads(refused.value.read())["error"]
    with pytest.raises(HTTPError, match="400"):
        ask("derive", {"name": "own", "formula": "a", "of": {"a": [0, "own"]}})


@pytest.mark.parametrize("text", ["1e999", "1" + "0" * 400])
@pytest.mark.parametrize("path", ["values", "points", "layouts", "export.csv"])
def test_a_number_that_no_double_holds_is_a_wrong_request(page: tuple[ViewPage, Ask], path: str, text: str) -> None:
    made, ask = page
    content = (
        f'{{"at": {text}, "from": 0, "to": {text}, "width": 9, "curves": [[0, "x"]], "name": "a", "layout": {text}}}'
    )
    query = f"?{urlencode({'of': content})}" if "export" in path else ""
    data = None if query else content.encode()
    request = urllib.request.Request(made.server.url + path + query, data, {"Content-Type": "application/json"})
    with pytest.raises(HTTPError, match="400"):
        urllib.request.urlopen(request, timeout=10)
    assert ask("about")["runs"]


def test_names_with_control_characters_are_shown_as_escapes_and_half_characters_are_answered(tmp_path: Path) -> None:
    file = tmp_path / "r.csv"
    file.write_text("time,x\x1b[31m\u202e [m]\n0,1\n1,2\n")
    run = ViewedRun(RunPlace("\udfff", "r\x1b", file), open_rows(file, ColumnTypes()), file_state(file))
    with ViewPage("run", [run], Layouts(tmp_path / "view.json")) as page:
        ask = _asking(page)
        about = ask("about")
        assert about["runs"][0]["label"] == r"r\u001b"
        ((name,), units, _) = about["sets"][0]
        assert (name, units) == (r"x\u001b[31m\u202e", ["m"])
        assert np.frombuffer(ask("values", {"at": 1.0, "curves": [[0, name]]}))[1] == 2.0
        assert ask("derive", {"name": "twice", "formula": "a", "of": {"a": [0, name]}})[0]["unit"] == "m"


def test_another_token_reads_nothing(page: tuple[ViewPage, Ask]) -> None:
    with pytest.raises(HTTPError, match="404"):
        urllib.request.urlopen(f"{page[0].server.origin}/{'x' * 43}/about", timeout=10)


def test_layouts_are_kept_in_a_file(page: tuple[ViewPage, Ask], tmp_path: Path) -> None:
    _, ask = page
    assert ask("layouts", {"name": "one", "layout": {"plots": []}}) == {"one": {"plots": []}}
    assert Layouts(tmp_path / "view.json").read() == {"one": {"plots": []}}
    assert ask("layouts", {"name": "one", "layout": None}) == {}


def test_texts_come_at_the_cursor_and_in_exports(tmp_path: Path) -> None:
    file = tmp_path / "results.csv"
    results = _with_texts(file, 4)
    run = ViewedRun(
        RunPlace("r0", "run 0", file), open_rows(file, ColumnTypes(text=[*results.exact])), file_state(file)
    )
    with ViewPage("run 0", [run], Layouts(tmp_path / "view.json")) as page:
        ask = _asking(page)
        assert ask("about")["sets"][0][2] == ["fmu.id", "fmu.count", "fmu.mode", "fmu.raw"]
        names = [[0, name] for name in ("fmu.id", "fmu.mode", "fmu.raw")]
        assert ask("texts", {"at": 0.25, "curves": names}) == [str(2**64 - 1), "run, fast", "ff02"]
        assert ask("texts", {"at": -1.0, "curves": names}) == [None, None, None]
        assert "a signal" in _refusal(ask, "points", {"from": 0, "to": 1, "width": 9, "curves": [[0, "fmu.mode"]]})
        of = urlencode({"of": json.dumps({"from": 0.15, "to": 0.35, "curves": [[0, "fmu.x"], *names]})})
        rows = ask(f"export.csv?{of}").decode().splitlines()
        assert rows[1:] == [
            '0.2,1.0,18446744073709551615,"run, fast",ff02',
            "0.30000000000000004,1.0,9007199254740993,,ff03",
        ]
        assert "another name" in _refusal(ask, "derive", {"name": "fmu.raw", "formula": "a", "of": {"a": [0, "fmu.x"]}})
        file.unlink()
        assert ask("texts", {"at": 0.25, "curves": names}) == [None, None, None]


@pytest.mark.parametrize(
    ("layout", "words"),
    [
        ({"plots": 3}, "layouts.one.plots: it should be a list"),
        ({}, "layouts.one.plots: it is missing"),
        ({"plots": [{"kind": "pie", "axes": []}]}, "layouts.one.plots.0.kind: it should be 'time' or 'xy'"),
        ({"plots": [{"axes": [{"curves": [{"run": "r0"}]}]}]}, "curves.0.name: it is missing"),
        ({"plots": [{"axes": [{"curves": []}] * 5}]}, "layouts.one.plots.0.axes"),
        ({"plots": [], "view": {"from": float("nan"), "to": 1}}, "view.from: it should be a finite number"),
        ({"plots": [], "derived": [{"name": "d", "formula": "a", "of": {}}]}, "derived.0.of: it names no signal"),
    ],
)
def test_a_layout_that_is_none_is_refused_by_its_place_and_the_file_stays(
    page: tuple[ViewPage, Ask], tmp_path: Path, layout: Any, words: str
) -> None:
    _, ask = page
    ask("layouts", {"name": "good", "layout": {"plots": []}})
    before = (tmp_path / "view.json").read_bytes()
    assert words in _refusal(ask, "layouts", {"name": "one", "layout": layout})
    content = {"schema_version": 1, "layouts": {"one": layout}}
    assert words in _refusal(ask, "layouts", {"file": "of a colleague.json", "content": content})
    assert (tmp_path / "view.json").read_bytes() == before
    (tmp_path / "wrong.json").write_text(json.dumps(content))
    with pytest.raises(InputError) as refused:
        Layouts(tmp_path / "wrong.json")
    assert words in str(refused.value)


@pytest.mark.parametrize("content", [None, 3, [], {}, {"schema_version": 2, "layouts": {}}])
def test_a_file_that_the_page_opens_and_that_holds_no_layouts_is_refused(
    page: tuple[ViewPage, Ask], content: Any
) -> None:
    assert "no file of layouts" in _refusal(page[1], "layouts", {"file": "x.json", "content": content})


def test_a_run_that_is_removed_is_told_and_the_others_stay(page: tuple[ViewPage, Ask], tmp_path: Path) -> None:
    made, ask = page
    (tmp_path / "r0.csv").unlink()
    points = np.frombuffer(ask("points", {"from": 0, "to": 1, "width": 9, "curves": [[0, "x"], [1, "x"]]}))
    assert points[0] == -1
    assert points[2] == 3
    made._looked = 0.0
    made.version()
    assert "run 0 was removed or replaced" in made.state()["lost"][0]


def test_results_of_the_worked_way_are_as_read(folder: Path) -> None:
    (place,), _ = find_runs(["2"], Path("results"))
    (run,), _ = open_runs([place], _no_bar)
    np.testing.assert_array_equal(run.rows.read("tank.level"), read_results(place.file)["tank.level"])
