"""Results in a notebook: charts of limited size, a line of progress, and runs within a running event loop."""

from __future__ import annotations

import asyncio
import html
import re
from pathlib import Path

import numpy as np
import pytest

import cosim
from cosim.calibration.fitted import Fitted
from cosim.core.errors import InputError
from cosim.files.results import Results
from cosim.refinement.refinement import Refined
from cosim.report.cell.cell import MAX_CELL_CURVES, rows_to_show
from cosim.simulation.run_signals import Signals
from tests.test_python import turning

PEAK = 123_457  # row of a single high value


def signals(rows: int, curves: int, name: str = "tank.s{}") -> Signals:
    time = np.arange(rows) * 0.01
    values = np.column_stack([np.sin(time * (k + 1) / 3.0) for k in range(curves)])
    if rows > PEAK:
        values[PEAK, 0] = 9.0
    columns = tuple(name.format(k) for k in range(curves))
    return Signals("made", Results(time, columns, values, dict.fromkeys(columns, "m")))


def frames(page: str) -> list[str]:
    """The pages in the frames of a cell."""
    return [html.unescape(text) for text in re.findall(r'<iframe [^>]*srcdoc="([^"]*)"></iframe>', page)]


def test_a_long_result_shows_its_peaks_in_a_frame_of_a_bounded_size_that_reaches_nothing() -> None:
    long = signals(150_000, 30)
    shown = long._repr_html_()
    (frame,) = frames(shown)
    assert 'sandbox="allow-scripts allow-downloads"' in shown  # without the rights of the notebook
    assert "default-src 'none'" in frame
    assert not re.findall(r"""(?:src|href)=["']?(?:https?:)?//""", frame)
    assert len(shown) < 700_000
    assert long._ipython_key_completions_() == [*long.names]
    assert long.plot("tank.s1")._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]
    rows = rows_to_show([long[name] for name in long.names[:MAX_CELL_CURVES]])
    assert {0, PEAK, 149_999} <= {*rows.tolist()}
    assert "tank.s0 from -1 to 9" in frame


@pytest.mark.parametrize("rows", [0, 1])
def test_a_result_without_curves_shows_its_table(rows: int) -> None:
    shown = signals(rows, 2)._repr_html_()
    assert "<td>tank.s1</td>" in shown
    assert len(frames(shown)) == rows


def test_no_name_of_a_signal_becomes_code() -> None:
    evil = '</script><img src=x onerror="alert(1)">{}'
    shown = signals(50, 2, evil)._repr_html_()
    (frame,) = frames(shown)
    assert "<img" not in shown + frame


def test_a_comparison_and_estimates_show_themselves(tmp_path: Path) -> None:
    time = np.arange(9.0)
    runs = [
        Signals(name, Results(time, ("x",), time[:, np.newaxis] ** k, {"x": "m"})) for k, name in enumerate("ab", 1)
    ]
    (frame,) = frames(cosim.compare(*runs)._repr_html_())
    assert "x minus a" in frame
    entry = {"start": 1.0, "value": 2.0, "unit": "kg", "ci95": [1.5, 2.5], "status": "estimated"}
    fitted = Fitted({"verdict": "improved", "sentence": "a < b", "parameters": {"mass": entry}})._repr_html_()
    assert "a &lt; b" in fitted
    assert "<td>1.5 … 2.5</td>" in fitted
    effect = {"name": "leak", "parameters": {"rate": {"value": 0.012, "unit": "m2/s", "ci95": [0.01, 0.014]}}}
    refined = Refined({"verdict": "effect_found", "sentence": "found", "effects": [effect]}, tmp_path)
    assert "<td>leak.rate</td><td>0.012</td>" in refined._repr_html_()


# -- within an event loop, and in a kernel --------------------------------------------------------------


def test_runs_within_a_running_event_loop_and_beside_it(tmp_path: Path) -> None:
    async def cell() -> list[float]:
        here = cosim.run(turning(tmp_path))  # in a worker process
        beside = await asyncio.to_thread(cosim.run, turning(tmp_path), set={"components.a.start.r_in": 3})
        return [float(made["a.r_out"][-1]) for made in (here, beside)]

    assert asyncio.run(cell()) == [2.0, 3.0]


def test_a_faulty_input_is_a_message_in_a_notebook_without_the_frames_of_the_package() -> None:
    with pytest.raises(InputError) as caught:
        cosim.run("nothing.yaml")
    shown = caught.value._render_traceback_()  # IPython shows these lines in place of the frames
    assert shown == ["InputError: nothing.yaml: no such file; give a scenario or a manifest"]
