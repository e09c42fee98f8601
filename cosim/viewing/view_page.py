"""The page of the signal browser: points of pictures, values at the cursor, derived signals, exports, layouts."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import InputError
from cosim.base.scratch import process_folder
from cosim.base.version import __version__
from cosim.report.template import DESK, render
from cosim.server.answers import Answer, Handler, Request, json_answer
from cosim.server.served_page import ServedPage
from cosim.storage.csv_source import cell_text, write_table
from cosim.storage.files import parse_json
from cosim.viewing.derivations import Definition, Derivations
from cosim.viewing.layouts import Layouts, check_layouts
from cosim.viewing.pyramid import TIME, Picture
from cosim.viewing.viewed_runs import ViewedRun

TEMPLATE = Path(__file__).with_name("templates") / "view.html.j2"
WIDEST, MOST_POINTS = 8192, 20_000  # pixel columns of a picture, points of a plane
MOST_CELLS = 50_000_000  # values of an exported table
LOOK = 1.0  # [s] between looks at the files of the runs
LOST = (np.array([-1.0, 0.0]),)  # in the place of points of a run that is lost


class ViewPage(ServedPage):
    """The page of runs; rows are read for what it shows only.

    Args:
        title: Heading.
        notes: Texts shown at the beginning.
    """

    def __init__(
        self, title: str, runs: Sequence[ViewedRun], layouts: Layouts, port: int = 0, *, notes: Sequence[str] = ()
    ) -> None:
        self._runs, self._layouts, self._notes = list(runs), layouts, list(notes)
        self._looked, self._exports = 0.0, count()
        self._derivations = Derivations(self._runs)
        html = render(TEMPLATE, {"heading": title, "version": __version__, "data": '{"rows": 0}'}, also=DESK)
        super().__init__(html, port)

    def routes(self) -> Mapping[str, Handler]:
        """Return further routes."""
        return {
            "GET /about": self._about,
            "POST /points": self._points,
            "POST /plane": self._plane,
            "POST /values": self._values,
            "POST /texts": self._texts,
            "POST /derive": self._derive,
            "POST /layouts": self._save_layout,
            "GET /export.csv": self._export,
        }

    def version(self) -> Any:
        """Return a value that changes with the state; look at times whether all runs are still there."""
        now = time.monotonic()
        if now - self._looked > LOOK:
            self._looked = now
            lost = [run.lost for run in self._runs if not run.check()]
            if lost != self._state.get("lost", []):
                self.update(lost=lost)
        return self._version

    # -- requests -------------------------------------------------------------------------------------

    def _about(self, request: Request) -> Answer:
        """Return the runs, with names and units of numbers and names of texts; runs with equal signals share them."""
        sets: list[Any] = []
        runs = []
        for run in self._runs:
            signals = [[*run.rows.units], [*run.rows.units.values()], [*run.rows.texts]]
            if signals not in sets:
                sets.append(signals)
            first, last = run.rows.span()
            place = {"name": run.place.name, "label": run.place.label, "file": str(run.place.file)}
            runs.append({**place, "set": sets.index(signals), "rows": run.rows.rows, "from": first, "to": last})
            runs[-1]["derived"] = self._derivations.of_run(len(runs) - 1)
        return json_answer({"runs": runs, "sets": sets, "layouts": self._layouts.read(), "notes": self._notes})

    def _points(self, request: Request) -> Answer:
        """Return for each curve the number of points, whether these are rows, then time, least and largest values.

        A third number says whether the time follows: curves of a run share that of the first one.
        """
        begin, end, width = _number(request, "from"), _number(request, "to"), int(_number(request, "width"))
        if not begin < end or not 0 < width <= WIDEST:
            raise _refused("a range of times and a width")
        pictures: dict[int, Picture] = {}

        def points(run: ViewedRun, name: str) -> list[Array]:
            if is_first := id(run) not in pictures:
                pictures[id(run)] = run.rows.picture(begin, end, width)
            picture = pictures[id(run)]
            low, high = picture.points(name)
            is_row = picture.starts is None
            head = np.array([low.size, float(is_row), float(is_first)])
            return [head, *([picture.time] if is_first else []), low, *([] if is_row else [high])]

        return _binary([part for curve in self._curves(request) for part in _unless_lost(curve[0], points, *curve)])

    def _plane(self, request: Request) -> Answer:
        """Return for each pair of signals the number of points, the distance of their rows, then time, x and y."""
        begin, end, most = _number(request, "from"), _number(request, "to"), int(_number(request, "width"))

        def plane(run: ViewedRun, x: str, y: str) -> list[Array]:
            step, columns = run.rows.every([TIME, x, y], begin, end, max(2, min(most, MOST_POINTS)))
            return [np.array([columns[0].size, float(step)]), *columns]

        curves, across = self._curves(request), self._curves(request, "across")
        if [run for run, _ in curves] != [run for run, _ in across]:
            raise _refused("signals of one run for both axes")
        pairs = [(run, x, y) for (run, x), (_, y) in zip(across, curves, strict=True)]
        return _binary([part for pair in pairs for part in _unless_lost(pair[0], plane, *pair)])

    def _values(self, request: Request) -> Answer:
        """Return time and value of each curve at its last row up to a time; NaN before the first."""
        at = _number(request, "at")
        places: dict[int, int] = {}

        def value(run: ViewedRun, name: str) -> list[Array]:
            if id(run) not in places:
                places[id(run)] = run.rows.locate(at, "right") - 1
            row = places[id(run)]
            return [run.rows.read(each, row, row + 1) if row >= 0 else np.array([np.nan]) for each in (TIME, name)]

        nothing = [np.full(2, np.nan)]
        return _binary(
            [p for curve in self._curves(request) for p in _unless_lost(curve[0], value, *curve, lost=nothing)]
        )

    def _texts(self, request: Request) -> Answer:
        """Return the text of each signal at its last row up to a time; null before the first, and of a lost run."""
        at = _number(request, "at")

        def text(run: ViewedRun, name: str) -> list[str | None]:
            row = run.rows.locate(at, "right") - 1
            return [run.rows.text(name, row) if row >= 0 else None]

        asked = _content(request).get("curves")
        curves = [self._curve(curve, texts=True) for curve in asked] if isinstance(asked, list) else []
        return json_answer([t for curve in curves for t in _unless_lost(curve[0], text, *curve, lost=[None])])

    def _derive(self, request: Request) -> Answer:
        """Add, change or remove a derived signal; return the signals with new values."""
        content = _content(request)
        if "remove" in content:
            removed, signal = self._curve(content["remove"])
            self._derivations.remove(self._runs.index(removed), signal)
            return json_answer([])
        name, text, of, unit = (content.get(key) for key in ("name", "formula", "of", "unit"))
        is_named = isinstance(name, str) and name.strip() and isinstance(text, str) and isinstance(unit or "", str)
        if not (is_named and isinstance(of, dict) and of):
            raise _refused("a name, a formula and its signals")
        curves = {str(letter): self._curve(curve) for letter, curve in of.items()}
        signals = {letter: (self._runs.index(run), each) for letter, (run, each) in curves.items()}
        definition = Definition(str(text), signals, str(unit or "").strip())
        try:
            return json_answer(self._derivations.define(str(name), definition))
        except OSError:
            lost = next((run.lost for run, _ in curves.values() if not run.check()), "its rows cannot be read")
            raise InputError.at(Path("formula"), f"cannot be read: {lost}") from None

    def _save_layout(self, request: Request) -> Answer:
        """Save a layout, or return the layouts of a file that the page has opened."""
        content = _content(request)
        if "file" in content:
            return json_answer(check_layouts(Path(str(content["file"])), content.get("content")))
        return json_answer(self._layouts.put(content.get("name"), content.get("layout")))

    def _export(self, request: Request) -> Answer:
        """Return all rows of curves between two times as CSV, time first, a row for each time of any run."""
        try:
            content = parse_json(request.query.get("of", ""))
        except (ValueError, RecursionError):
            content = None
        asked = Request("", content=content)
        begin, end, curves = _number(asked, "from"), _number(asked, "to"), self._curves(asked, texts=True)
        file = process_folder() / f"view-{next(self._exports)}.csv"
        several = len({id(run) for run, _ in curves}) > 1
        heads, columns, places = list[str](), list[Array | list[str]](), list[tuple[Array, Array]]()
        cells = 0.0
        for run, name in curves:
            first, stop = run.rows.locate(begin), run.rows.locate(end, "right")
            cells += stop - first
            if cells > MOST_CELLS:
                raise InputError.at(
                    Path("export"),
                    (
                        f"these are {cells / 1e6:.0f} million values, more than {MOST_CELLS / 1e6:.0f} million; zoom "
                        "in first"
                    ),
                )
            at, values = run.rows.read(TIME, first, stop), run.rows.exact(name, first, stop)
            unit = {**run.rows.units, **run.rows.added}.get(name, "")
            heads.append(f"{f'{run.place.label}: ' * several}{name}{f' [{unit}]' * bool(unit)}")
            columns.append(values)
            places.append(
                (at, np.arange(at.size, dtype=float) - np.searchsorted(at, at))
            )  # the number among rows of one time
        write_table(file, ["time", *heads], _joined_rows(places, columns), _cell)
        return Answer(
            kind="text/csv; charset=utf-8",
            file=file,
            is_temporary=True,
            headers={"Content-Disposition": 'attachment; filename="view.csv"'},
        )

    # -- content of requests ----------------------------------------------------------------------------

    def _curves(self, request: Request, key: str = "curves", *, texts: bool = False) -> list[tuple[ViewedRun, str]]:
        curves = _content(request).get(key)
        if not isinstance(curves, list):
            raise _refused("a list of curves")
        found = [self._curve(curve, texts=texts) for curve in curves]
        for run in self._runs:
            run.rows.needed = frozenset(name for each, name in found if each is run)
        return found

    def _curve(self, curve: Any, *, texts: bool = False) -> tuple[ViewedRun, str]:
        """Return run and name of a curve, which is [number of the run, name of the signal].

        Args:
            texts: Whether a signal of texts is meant too.
        """
        if isinstance(curve, list) and len(curve) == 2 and isinstance(curve[0], int) and isinstance(curve[1], str):
            number, name = curve
            if 0 <= number < len(self._runs):
                run = self._runs[number]
                rows = run.rows
                if name == TIME or name in rows.units or name in rows.added or (texts and name in rows.texts):
                    return run, name
        raise _refused("a run and a signal that it has")


def _unless_lost(run: ViewedRun, read: Callable[..., list[Any]], *of: Any, lost: Sequence[Any] = LOST) -> Any:
    """Return what is read of a run; without its file or a file of its cache, the sign of a lost run."""
    if run.check():
        try:
            return read(*of)
        except OSError:
            run.lost = f"{run.place.label} was removed or replaced; what is drawn of it stays, zoom shows the others"
    return lost


def _content(request: Request) -> dict[str, Any]:
    if not isinstance(request.content, dict):
        raise _refused("an object")
    return request.content


def _number(request: Request, key: str) -> float:
    value = _content(request).get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise _refused(f"a finite number for {key}")
    return float(value)


def _refused(wanted: str) -> InputError:
    return InputError.at(Path("view"), f"the request is not understood: {f'give {wanted}'}")


def _binary(parts: Sequence[Array]) -> Answer:
    return Answer(b"".join(np.ascontiguousarray(part, "<f8").tobytes() for part in parts), "application/octet-stream")


def _joined_rows(places: Sequence[tuple[Array, Array]], columns: Sequence[Array | list[str]]) -> Iterator[list[Any]]:
    """Yield a row for each time of any column; rows of one time stay several."""
    if not places:
        return
    pairs = np.concatenate([np.column_stack(place) for place in places])
    rows, at = np.unique(pairs, axis=0, return_inverse=True)
    kind: Any = np.float64 if all(isinstance(values, np.ndarray) for values in columns) else object
    table, begin = np.full((len(rows), len(columns)), np.nan, kind), 0
    for k, values in enumerate(columns):
        table[at.ravel()[begin : begin + len(values)], k] = values
        begin += len(values)
    for moment, cells in zip(rows[:, 0].tolist(), table, strict=True):
        yield [moment, *cells.tolist()]


def _cell(value: float | str) -> str:
    if isinstance(value, str):
        return cell_text(value)
    return "" if math.isnan(value) else repr(value)
