"""The signal browser: points to draw, values at the cursor, exports, layouts."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat, ValidationError
from starlette.background import BackgroundTask
from starlette.requests import Request
from starlette.responses import FileResponse, Response

from cosim.core.arrays import Array
from cosim.core.errors import InputError
from cosim.core.scratch import process_folder
from cosim.core.text import displayed, showing, shown_unit
from cosim.files.csv_source import cell_text, write_table
from cosim.files.files import parse_json
from cosim.pages.layouts import Layouts
from cosim.pages.rows import TIME_COLUMN, Picture
from cosim.pages.runs import FILE_CHECK_INTERVAL_S, ViewedRun
from cosim.pages.server import Handler, Json, ServedPage
from cosim.report.template import render

TEMPLATE = Path(__file__).with_name("templates") / "view.html.j2"
MAX_PIXELS = 8192  # pixel columns of a time plot, points of an x-y plot
MAX_EXPORTED_VALUES = 50_000_000  # values of an exported table
MIN_SPECTRUM, MAX_SPECTRUM, MAX_SEGMENT = 16, 20_000_000, 16_384  # rows of a spectrum, and of its longest segment
Signal = tuple[int, str]  # number of the run, name
Curve = tuple[ViewedRun, str]


class Wanted(BaseModel):
    """A request for signals over a range of times [s], or at one time."""

    begin: FiniteFloat = Field(0.0, alias="from")
    end: FiniteFloat = Field(1.0, alias="to")
    at: FiniteFloat = 0.0
    width: int = Field(1, gt=0, le=MAX_PIXELS)
    curves: list[Signal]
    across: list[Signal] = []


class Viewer:
    """The state of a page with runs, and answers to its requests; only rows that the page needs are read.

    Args:
        notes: Texts shown at the beginning.
    """

    def __init__(self, runs: Sequence[ViewedRun], layouts: Layouts | None, notes: Sequence[str] = ()) -> None:
        self.runs, self._layouts, self._notes = list(runs), layouts, list(notes)
        self._looked, self._exports = 0.0, count()
        self._lock = threading.Lock()

    def routes(self) -> dict[str, Handler]:
        """Return the routes of the page."""
        data = self._points, self._plane, self._spectrum, self._statistics, self._values, self._texts
        return {
            "GET /about": self._about,
            "POST /layouts": self._save_layout,
            "GET /export.csv": self._export,
            **{f"POST /{f.__name__[1:]}": partial(_of_request, f) for f in data},
        }

    def state(self) -> dict[str, Any]:
        """Return the numbers of rows, the time ranges, and the reasons why runs are lost."""
        with self._lock:
            if time.monotonic() - self._looked > FILE_CHECK_INTERVAL_S:
                for run in self.runs:
                    run.follow()
                self._looked = time.monotonic()
        spans = [[run.rows.rows, *run.rows.span()] for run in self.runs]
        return {"lost": [run.lost for run in self.runs if run.lost], "spans": spans}

    # -- requests -------------------------------------------------------------------------------------

    def _about(self, request: Request, _: Any) -> Response:
        """Return the runs, with names and units of numeric signals and names of text signals."""
        runs = []
        for run in self.runs:
            with showing(*(run.record for run in self.runs)):
                units = [shown_unit(unit) for unit in run.rows.units.values()]
            first, last = run.rows.span()
            place = {"name": run.place.name, "label": run.place.label, "file": str(run.place.file)}
            signals = {"numbers": [*run.rows.units], "units": units, "texts": [*run.rows.texts], "judged": run.judged}
            span = {"rows": run.rows.rows, "from": first, "to": last}
            runs.append({**place, **signals, **span})
        layouts = self._layouts.read() if self._layouts is not None else {}
        return Json({"runs": runs, "layouts": layouts, "notes": self._notes})

    def _points(self, wanted: Wanted) -> Response:
        """Return for each curve: number of points, 1 for rows, then time, smallest and largest values."""
        if not wanted.begin < wanted.end:
            raise _invalid_request("a range of times")
        pictures: dict[int, Picture] = {}

        def points(run: ViewedRun, name: str) -> list[Array]:
            if id(run) not in pictures:
                pictures[id(run)] = run.rows.picture(wanted.begin, wanted.end, wanted.width)
            picture = pictures[id(run)]
            ends = (self._shown(run, name, values) for values in picture.points(name))
            return [np.array([picture.time.size, float(picture.starts is None)]), picture.time, *ends]

        return _arrays(points, self._curves(wanted.curves))

    def _plane(self, wanted: Wanted) -> Response:
        """Return, for each pair of signals of an x-y plot: number of points, row spacing, then time, x and y."""

        def plane(run: ViewedRun, x: str, y: str) -> list[Array]:
            rows = run.rows
            first, stop = max(0, rows.locate(wanted.begin) - 1), min(rows.rows, rows.locate(wanted.end, "right") + 1)
            step = max(1, -(-(stop - first) // max(2, wanted.width)))
            columns = [self._shown(run, name, rows.read(name, first, stop)[::step]) for name in (TIME_COLUMN, x, y)]
            return [np.array([columns[0].size, float(step)]), *columns]

        curves, across = self._curves(wanted.curves), self._curves(wanted.across)
        if [run for run, _ in curves] != [run for run, _ in across]:
            raise _invalid_request("signals of the same run for both axes")
        return _arrays(plane, [(run, x, y) for (run, x), (_, y) in zip(across, curves, strict=True)])

    def _spectrum(self, wanted: Wanted) -> Response:
        """Return, for each curve: number of points, 1, then log10 of the frequencies [Hz], and twice the level [dB].

        The power spectral density is computed by Welch's method from the rows between two times, interpolated at the
        median row spacing. A curve with few rows has no points.
        """
        from scipy.signal import welch

        def spectrum(run: ViewedRun, name: str) -> list[Array]:
            time, values = self._between(run, name, wanted)
            steps = np.diff(time)
            step = float(np.median(steps[steps > 0.0])) if time.size >= MIN_SPECTRUM else 0.0
            if not step or (time[-1] - time[0]) / step > MAX_SPECTRUM:
                return [np.array([0.0, 1.0])]
            equal = np.interp(np.arange(time[0], time[-1], step), time, values)
            segment = min(equal.size, max(256, equal.size // 8), MAX_SEGMENT)
            frequencies, power = welch(equal, 1.0 / step, nperseg=segment)
            with np.errstate(divide="ignore"):
                levels = np.where(power > 0.0, 10.0 * np.log10(power), np.nan)[1:]
            return [np.array([levels.size, 1.0]), np.log10(frequencies[1:]), levels, levels]

        return _arrays(spectrum, self._curves(wanted.curves))

    def _statistics(self, wanted: Wanted) -> Response:
        """Return minimum, maximum, mean, RMS and standard deviation of each curve over its rows."""

        def statistics(run: ViewedRun, name: str) -> list[Array]:
            _, values = self._between(run, name, wanted)
            if not values.size:
                return [np.full(5, np.nan)]
            return [np.array([values.min(), values.max(), values.mean(), np.sqrt(np.mean(values**2)), values.std()])]

        return _arrays(statistics, self._curves(wanted.curves))

    def _between(self, run: ViewedRun, name: str, wanted: Wanted) -> tuple[Array, Array]:
        """Return times and displayed values of a signal between two times, without missing values."""
        first, stop = run.rows.locate(wanted.begin), run.rows.locate(wanted.end, "right")
        time, values = run.rows.read(TIME_COLUMN, first, stop), self._shown(run, name, run.rows.read(name, first, stop))
        has_value = np.isfinite(values)
        return time[has_value], values[has_value]

    def _values(self, wanted: Wanted) -> Response:
        """Return time and value of each curve at its last row before or at a time; NaN before the first row."""

        def value(run: ViewedRun, name: str) -> list[Array]:
            row = run.rows.locate(wanted.at, "right") - 1
            if row < 0:
                return [np.full(2, np.nan)]
            return [self._shown(run, each, run.rows.read(each, row, row + 1)) for each in (TIME_COLUMN, name)]

        return _arrays(value, self._curves(wanted.curves))

    def _texts(self, wanted: Wanted) -> Response:
        """Return the text of each signal at its last row before or at a time; null before the first row."""
        texts = list[str | None]()
        for run, name in self._curves(wanted.curves, texts=True):
            row = run.rows.locate(wanted.at, "right") - 1
            texts.append(str(run.rows.exact(name, row, row + 1)[0]) if row >= 0 else None)
        return Json(texts)

    def _save_layout(self, request: Request, content: Any) -> Response:
        """Save or remove a layout; return all layouts."""
        layout = content.get("layout") if isinstance(content, dict) else ""
        if not (isinstance(layout, dict | None) and content.get("name")) or self._layouts is None:
            raise _invalid_request("a layout of `cosim view`")
        return Json(self._layouts.put(str(content["name"]), layout))

    def _export(self, request: Request, _: Any) -> Response:
        """Return all rows of curves between two times as CSV, time first, with a row for each time of any run."""
        try:
            content = parse_json(request.query_params.get("of", ""))
        except (ValueError, RecursionError):
            content = None
        wanted = _read(content)
        curves = self._curves(wanted.curves, texts=True)
        spans = [(run.rows.locate(wanted.begin), run.rows.locate(wanted.end, "right")) for run, _ in curves]
        if (cells := sum(stop - first for first, stop in spans)) > MAX_EXPORTED_VALUES:
            limit = f"more than {MAX_EXPORTED_VALUES / 1e6:.0f} million; zoom in first"
            raise InputError.at(Path("export"), f"the selection has {cells / 1e6:.0f} million values, {limit}")
        several, heads = len({id(run) for run, _ in curves}) > 1, ["time"]
        columns, places = list[Array | list[str]](), [np.empty((0, 2))]
        for (run, name), span in zip(curves, spans, strict=True):
            at, unit = run.rows.read(TIME_COLUMN, *span), run.rows.units.get(name, "")
            heads.append(f"{f'{run.place.label}: ' * several}{name}{f' [{unit}]' * bool(unit)}")
            columns.append(run.rows.exact(name, *span))
            # the time, and the number of the row among those of the same time, because all of them are kept
            places.append(np.column_stack((at, np.arange(at.size) - np.searchsorted(at, at))))

        def joined_rows() -> Iterator[list[Any]]:
            """Yield a row for each time of any column."""
            rows, at = np.unique(np.concatenate(places), axis=0, return_inverse=True)
            kind: Any = np.float64 if all(isinstance(values, np.ndarray) for values in columns) else object
            table, first = np.full((len(rows), len(columns)), np.nan, kind), 0
            for k, values in enumerate(columns):
                table[at.ravel()[first : first + len(values)], k] = values
                first += len(values)
            for moment, row in zip(rows[:, 0].tolist(), table, strict=True):
                yield [moment, *row.tolist()]

        def cell(value: float | str) -> str:
            return cell_text(value) if isinstance(value, str) else "" if math.isnan(value) else repr(value)

        file = process_folder() / f"view-{next(self._exports)}.csv"
        write_table(file, heads, joined_rows(), cell)
        remove = BackgroundTask(file.unlink, missing_ok=True)
        return FileResponse(file, media_type="text/csv", filename="view.csv", background=remove)

    def _shown(self, run: ViewedRun, name: str, values: Array) -> Array:
        """Convert values of a signal to its display unit."""
        with showing(*(each.record for each in self.runs)):
            shown: Array = displayed(values, run.rows.units.get(name, ""))
        return shown

    # -- content of requests ----------------------------------------------------------------------------

    def _curves(self, signals: Sequence[Signal], *, texts: bool = False) -> list[Curve]:
        """Return the run and name of signals.

        Args:
            texts: Accept signals of text too.
        """
        for number, name in signals:
            rows = self.runs[number].rows if 0 <= number < len(self.runs) else None
            if rows is None or not (name == TIME_COLUMN or name in rows.units or (texts and name in rows.texts)):
                raise _invalid_request("a run and one of its signals")
        return [(self.runs[number], name) for number, name in signals]


def view_page(
    title: str, runs: Sequence[ViewedRun], layouts: Layouts, port: int = 0, *, notes: Sequence[str] = ()
) -> ServedPage:
    """Return the page of finished runs.

    Args:
        title: Heading.
        notes: Texts shown at the beginning.
    """
    return ServedPage(view_html(title, is_live=False), port, Viewer(runs, layouts, notes))


def view_html(title: str, *, is_live: bool) -> str:
    """Return the page of finished runs, or of a running one."""
    return render(TEMPLATE, {"heading": title, "activity": "run" if is_live else ""}, is_report=False)


def _arrays(read: Callable[..., list[Array]], curves: Sequence[Sequence[Any]]) -> Response:
    """Return a response with the arrays that `read` returns of all curves, in a row, as little-endian doubles."""
    body = b"".join(np.ascontiguousarray(part, "<f8").tobytes() for curve in curves for part in read(*curve))
    return Response(body, media_type="application/octet-stream")


def _of_request(handle: Callable[[Wanted], Response], request: Request, content: Any) -> Response:
    return handle(_read(content))


def _read(content: Any) -> Wanted:
    try:
        return Wanted.model_validate(content)
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        raise _invalid_request(f"{'.'.join(map(str, fault['loc'])) or 'an object'} ({fault['msg']})") from None


def _invalid_request(wanted: str) -> InputError:
    """Return the error of a request without something that it needs."""
    return InputError.at(Path("view"), f"the request is invalid: give {wanted}")
