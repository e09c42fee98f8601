"""The signal browser without a browser: extremes of blocks, tables, its server, bad input."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import numpy as np
import pytest

from cosim.core.errors import InputError
from cosim.core.scratch import process_folder
from cosim.files.results import Results
from cosim.files.run_entries import entries
from cosim.pages import rows as tables
from cosim.pages.layouts import Layouts
from cosim.pages.rows import TIME_COLUMN, Recording, open_rows
from cosim.pages.runs import RunPlace, ViewedRun, find_runs, open_runs
from cosim.pages.server import ServedPage
from cosim.pages.view_page import view_page
from tests.live_pages import ask as asked
from tests.test_first_steps import told

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


def recording(time: Array, values: Array, *, grows: bool) -> Recording:
    """A recording, or one to which rows are added in parts, the last of at most three rows."""
    if not grows:
        return Recording({TIME_COLUMN: time, "x": values}, {"x": "m"})
    record, ends = Recording({}, {"x": "m"}), np.cumsum(RNG(5).integers(1, 20_000, 30))
    for part in np.split(np.vstack((time, values)), [*ends[ends < time.size - 3], time.size - 3], axis=1):
        record.append(part)
        record.extremes("x")
    return record


# -- pictures ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["uniform", "bursts", "events"])
@pytest.mark.parametrize(("rows", "grows"), [(1, False), (17, True), (300_000, False), (100_000, True)])
def test_a_picture_has_the_extremes_of_the_rows_in_every_pixel_column(kind: str, rows: int, grows: bool) -> None:
    time, rng, width = times(kind, rows), RNG(1), 200
    values = rng.standard_normal(rows)
    values[rng.random(rows) < 0.2] = np.nan
    values[rows // 3 : rows // 2] = np.nan
    record = recording(time, values, grows=grows)
    assert (record.rows, *record.span()) == (rows, time[0], time[-1])
    for begin, end in ((time[0], time[-1] + 1e-9), (time[rows // 4], time[rows // 2] + 1e-3)):
        picture = record.picture(begin, end, width)
        low, high = picture.points("x")
        assert picture.time.size <= max(4 * width, width + 3)
        assert np.all(np.diff(picture.time) >= 0.0)
        seen = np.flatnonzero((time >= begin) & (time <= end) & np.isfinite(values))
        # Each row, the extremes too, lies within those of a point at most a pixel column and a block away.
        ends = [seen[values[seen].argmin()], seen[values[seen].argmax()], *rng.choice(seen, 20)] if seen.size else []
        for row in ends:
            near = np.abs(picture.time - time[row]) <= 1.6 * (end - begin) / width
            assert np.nanmin(low[near]) <= values[row] <= np.nanmax(high[near])


# -- tables --------------------------------------------------------------------------------------------


def table(path: Path, rows: int) -> Results:
    rng = RNG(3)
    values = np.cumsum(rng.standard_normal((rows, 3)), axis=0)
    values[100:5000, 1] = np.nan
    time = np.cumsum(np.where(rng.random(rows) < 0.1, 0.0, 1e-3))
    results = Results(time, ("a.x", "a", "A"), values, {"a.x": "m", "a": "", "A": "N"})
    results.write(path)
    return results


@pytest.fixture(params=[False, True], ids=["memory", "files"])
def stored(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Read small tables as they are, or convert them too."""
    if request.param:
        monkeypatch.setattr(tables, "MAX_MEMORY_BYTES", 0)
    return bool(request.param)


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".mat"])
def test_a_converted_table_gives_what_memory_gives(
    tmp_path: Path, suffix: str, stored: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"results{suffix}"
    results = table(path, 30_000)
    rows = open_rows(path)
    assert rows.column("a").flags.writeable is not (stored or path.stat().st_size > 4e6)  # a file is mapped
    for name in results.columns:
        np.testing.assert_array_equal(rows.read(name), results[name])
    if stored:
        monkeypatch.setattr(tables, "read_results", lambda *_, **__: pytest.fail("converted twice"))
        assert open_rows(path).rows == rows.rows


def test_a_changed_table_is_converted_again_and_old_conversions_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tables, "MAX_MEMORY_BYTES", 0)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path, cache = tmp_path / "results.csv", tmp_path / "cache" / "cosim" / "view"
    table(path, 5000)
    assert open_rows(path).rows == 5000
    (first,) = cache.iterdir()
    table(path, 6000)
    os.utime(first, (0.0, 0.0))
    assert open_rows(path).rows == 6000
    (second,) = cache.iterdir()
    assert second != first


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("time,x\n0,1\n1,2\n0.5,3\n", "results.csv:4"),
        ("time,x\n0,1\n1\n", "results.csv:3"),
        ("time,x\n0,1\n,2\n", "results.csv"),
        ("time,x\n", "results.csv"),
        ("", "results.csv"),
    ],
)
@pytest.mark.usefixtures("stored")
def test_a_faulty_table_is_refused_with_the_place_and_leaves_nothing(tmp_path: Path, text: str, place: str) -> None:
    path = tmp_path / "results.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=place):
        open_rows(path)
    assert [*tmp_path.iterdir()] == [path]


LARGE = [2**53 + 1, 2**63, 2**64 - 1]  # more digits than a double has


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".hdf5"])
@pytest.mark.usefixtures("stored")
def test_integers_of_64_bits_are_numbers_and_texts_and_texts_are_texts(tmp_path: Path, suffix: str) -> None:
    exact: dict[str, list[Any]] = {
        "fmu.id": LARGE * 100,
        "fmu.mode": ["idle"] * 298 + ["run, fast", ""],
        "fmu.word": ["42"] * 300,
        "fmu.raw": [bytes([255, k % 7]) for k in range(300)],
    }
    results = Results(np.arange(300.0), ("fmu.x",), np.ones((300, 1)), {"fmu.x": "m"}, exact)
    results.write(path := tmp_path / f"results{suffix}")
    texts, words = results.texts(), frozenset({"fmu.word", "fmu.raw", "fmu.mode"})
    rows = open_rows(path, text=[*exact], words=words)
    assert ({*rows.units}, {*rows.texts}) == ({"fmu.x", "fmu.id"}, {*texts})
    np.testing.assert_array_equal(rows.read("fmu.id"), np.array(LARGE * 100, dtype=float))
    for name, row in ((name, row) for name in texts for row in (0, 298, 299)):
        assert rows.exact(name, row, row + 1) == [texts[name][row]]


# -- runs ----------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two runs of a tank, of which the manifest of the second has been cut off, and one that has no rows."""
    monkeypatch.chdir(tmp_path)
    manifest = json.dumps({"scenario": {"name": "tank", "components": {}}, "units": {"tank.level": "m"}})
    rows = "time,tank.level,tank.Level\n0,1,5\n1,2,6\n"
    for k, (name, about, text) in enumerate(
        (("tank/0001", manifest, rows), ("tank/0002", manifest[:20], rows), ("half", manifest, "time,x\n0\n"))
    ):
        run = tmp_path / "results" / name
        run.mkdir(parents=True, exist_ok=True)
        (run / "manifest.json").write_text(about)
        (run / "results.csv").write_text(text)
        os.utime(run / "manifest.json", (1e9 + k, 1e9 + k))
    return tmp_path


def test_tables_of_one_folder_and_one_stem_have_different_names(tmp_path: Path) -> None:
    texts = [str(tmp_path / name) for name in ("log.csv", "log.txt")]
    for text in texts:
        Path(text).write_text("time,x\n0,1\n1,2\n")
    places, _ = find_runs(texts, tmp_path)
    assert len({place.name for place in places}) == len({place.label for place in places}) == 2


def test_runs_without_names_are_all_that_can_be_read(folder: Path) -> None:
    places, _ = find_runs((), Path("results"))
    runs, warnings = open_runs(places)
    assert [run.place.name for run in runs] == ["tank/0001", "tank"]
    assert len(warnings) == 2  # the torn manifest of tank, and half is left out
    assert runs[0].rows.units == {"tank.level": "m", "tank.Level": ""}  # names that differ in case only


@pytest.mark.parametrize("words", ["nothing", "9", "half", "text.txt", "--layout wrong.json", "--results empty"])
def test_bad_input_ends_with_code_2_and_leaves_all_as_it_is(folder: Path, words: str) -> None:
    (folder / "text.txt").write_text("words\n")
    (folder / "wrong.json").write_text('{"layouts": []}')
    entries()  # which gives the results their numbers
    before = sorted(folder.rglob("*"))
    told("view", *words.split(), "--no-browser", "--prepare", code=2)
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
    return lambda path, *content: asked(page.url + path, *content)


def refusal(ask: Ask, path: str, content: Any = None) -> str:
    """The reason why a request is refused."""
    return str(ask(path, content, 400)["error"])


def values_at(ask: Ask, at: float, *curves: list[Any]) -> list[float]:
    """Values of curves at a time."""
    found: list[float] = np.frombuffer(ask("values", {"at": at, "curves": curves}))[1::2].tolist()
    return found


def test_points_values_planes_and_tables_come_from_the_server(page: tuple[ServedPage, Ask]) -> None:
    _, ask = page
    span = {"from": 0.0, "to": 1.0}
    assert [(r["numbers"], r["units"], r["texts"]) for r in ask("about")["runs"]] == [(["x", "y"], ["m", ""], [])] * 2
    points = np.frombuffer(ask("points", {**span, "width": 100, "curves": [[0, "x"], [1, "y"]]}))
    np.testing.assert_array_equal(points, [3, 1, 0, 1, 1, *[0, 1, 2] * 2, 3, 1, 0, 1, 1, *[1, np.nan, 3] * 2])
    plane = np.frombuffer(ask("plane", {**span, "width": 100, "across": [[0, "x"]], "curves": [[0, "y"]]}))
    np.testing.assert_array_equal(plane, [3, 1, 0, 1, 1, 0, 1, 2, 1, np.nan, 3])
    of = urlencode({"of": json.dumps({**span, "curves": [[0, "x"], [1, "y"]]})})
    assert ask(f"export.csv?{of}").decode() == "time,run 0: x [m],run 1: y\n0.0,0.0,1.0\n1.0,1.0,\n1.0,2.0,3.0\n"
    until = time.monotonic() + 10
    while [*process_folder().glob("view-*.csv")]:  # removed after its last byte was sent
        assert time.monotonic() < until
        time.sleep(0.01)


@pytest.mark.parametrize("small", [True, False])
def test_columns_of_a_table_are_named_by_the_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small: bool) -> None:
    if not small:
        monkeypatch.setattr(tables, "MAX_MEMORY_BYTES", 0)
    (tmp_path / "a.csv").write_text("count,stamp,v [m]\n7,0,1\n7,1,2\n7,2,3\n")
    run = RunPlace("a", "a", tmp_path / "a.csv", columns={"stamp": "time", "v": "speed"})
    rows = ViewedRun(run).rows
    assert (rows.read(TIME_COLUMN).tolist(), rows.read("speed").tolist()) == ([0, 1, 2], [1, 2, 3])
    assert rows.units["speed"] == "m"
    words = "view", "a.csv", "--prepare", "--column"
    monkeypatch.chdir(tmp_path)
    assert "1 run" in told(*words, "stamp=time")
    assert "stamp" in told(*words, "stam=time", code=2)
    assert "--column" in told("view", "--column", "stamp=time", code=2)


def test_statistics_and_spectra_are_those_of_the_rows_between_two_times(tmp_path: Path) -> None:
    time = np.arange(20_000) * 1e-3
    values = 3.0 + 2.0 * np.sin(2.0 * np.pi * 12.5 * time)
    values[100], values[15_000] = np.nan, 1e6  # a gap, and a peak after the range
    run = ViewedRun(
        RunPlace("r", "r", tmp_path / "r.csv"), rows=Recording({TIME_COLUMN: time, "x": values}, {"x": "m"})
    )
    (tmp_path / "r.csv").write_text("time,x\n")
    few = {"from": 0.0, "to": 0.01, "curves": [[0, "x"]]}
    with view_page("r", [run], Layouts(tmp_path / "view.json")) as page:
        ask, wanted = asking(page), {"from": 0.0, "to": 8.0, "curves": [[0, "x"]]}
        low, high, mean, rms, deviation = np.frombuffer(ask("statistics", wanted))
        count, _, *points = np.frombuffer(ask("spectrum", wanted))
        assert np.frombuffer(ask("spectrum", few)).tolist() == [0.0, 1.0]
        assert np.isnan(np.frombuffer(ask("statistics", {**wanted, "from": 30.0, "to": 31.0}))).all()
    assert (low, high) == pytest.approx((1.0, 5.0), abs=0.01)
    assert (mean, rms, deviation) == pytest.approx((3.0, math.sqrt(11.0), math.sqrt(2.0)), rel=1e-3)
    frequency, level = 10.0 ** np.array(points[: int(count)]), np.array(points[int(count) : 2 * int(count)])
    assert frequency[level.argmax()] == pytest.approx(12.5, abs=0.5)
    power = np.sum(10.0 ** (level / 10.0)) * (frequency[1] - frequency[0])
    assert power == pytest.approx(2.0, rel=0.01)  # half the square of the amplitude, by Parseval


@pytest.mark.parametrize(
    ("path", "content"),
    [
        ("points", {"from": 0, "to": 1, "width": 10**9, "curves": []}),
        ("plane", {"from": 0, "to": 1, "width": 10, "curves": [[0, "x"]], "across": [[1, "x"]]}),
        ("values", b'{"at": 1e999, "curves": [[0, "x"]]}'),
        ("export.csv?of=nothing", None),
    ],
)
def test_a_wrong_request_is_refused_and_the_page_stays(page: tuple[ServedPage, Ask], path: str, content: Any) -> None:
    refusal(page[1], path, content)
    assert page[1]("about")["runs"]


def test_names_with_control_characters_are_shown_as_escapes(tmp_path: Path) -> None:
    file = tmp_path / "r.csv"
    file.write_text("time,x\x1b[31m\u202e [m]\n0,1\n1,2\n")
    with view_page("run", [ViewedRun(RunPlace("\udfff", "r\x1b", file))], Layouts(tmp_path / "view.json")) as page:
        ask = asking(page)
        about = ask("about")
        assert about["runs"][0]["label"] == r"r\u001b"
        assert about["runs"][0]["numbers"] == [r"x\u001b[31m\u202e"]
        assert values_at(ask, 1.0, [0, about["runs"][0]["numbers"][0]]) == [2.0]


def test_layouts_are_kept_in_a_file_and_one_that_is_none_is_refused(
    page: tuple[ServedPage, Ask], tmp_path: Path
) -> None:
    _, ask = page
    assert ask("layouts", {"name": "good", "layout": {"plots": []}}) == {"good": {"plots": []}}
    before = (tmp_path / "view.json").read_bytes()
    for wrong in ({"name": "one", "layout": []}, {"layout": {"plots": []}}, []):
        refusal(ask, "layouts", wrong)
    assert (tmp_path / "view.json").read_bytes() == before
    assert ask("layouts", {"name": "good", "layout": None}) == {}


def test_a_run_that_grows_is_followed_and_one_that_is_removed_is_told(
    page: tuple[ServedPage, Ask], tmp_path: Path
) -> None:
    made, ask = page
    with (tmp_path / "r1.csv").open("a") as stream:
        stream.write("2,7,8\n")
    (tmp_path / "r0.csv").unlink()
    until = time.monotonic() + 20
    while made.state()["spans"][1] != [4, 0.0, 2.0] or len(made.state()["lost"]) < 1:
        assert time.monotonic() < until, made.state()
        time.sleep(0.1)
    assert values_at(ask, 5.0, [1, "x"]) == [7.0]
