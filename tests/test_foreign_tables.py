"""Tables in common foreign layouts, with every command that reads tables."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import cosim
from cosim.core.errors import InputError
from cosim.pages.runs import find_runs, open_runs
from cosim.simulation.run_signals import Signals

FOREIGN = "stamp;Left [%];other\n0;6,5;1\n0,02;6,6;2\n0,04;6,4;3\n"


@pytest.fixture
def table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "foreign.csv"
    path.write_text(FOREIGN, encoding="utf-8-sig")
    return path


def test_an_input_of_another_name_drives_the_fmu(table: Path, native_plant: Path) -> None:
    made = cosim.simulate(native_plant, input=table, columns={"Left": "duty_left"}, step=0.02)
    (column,) = (name for name in made.names if name.endswith(".duty_left"))
    np.testing.assert_array_equal(made[column][:3], [6.5, 6.6, 6.4])
    assert sum("foreign.csv" in text for text in made.warnings) >= 2  # separators and time were assumed
    with pytest.raises(InputError):
        cosim.simulate(native_plant, input=table, columns={"Left": "duty_lft"})
    with pytest.raises(InputError) as error:
        cosim.simulate(native_plant, columns={"Left": "duty_left"})
    assert error.value.exit_code == 2


def test_a_playback_a_browser_and_a_reader_take_it(table: Path) -> None:
    content = {
        "name": "p",
        "duration": 0.04,
        "step": 0.02,
        "components": {"log": {"block": "playback", "file": str(table)}},
    }
    played = cosim.run(content)
    np.testing.assert_array_equal(played["log.Left"], [6.5, 6.6, 6.4])
    read = cosim.read(table)
    assert isinstance(read, Signals)
    np.testing.assert_array_equal(read["other"], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(read.time, [0.0, 0.02, 0.04])
    (run,), _ = open_runs(find_runs([str(table)], Path())[0])
    assert (run.rows.rows, run.rows.units) == (3, {"Left": "%", "other": ""})
    assert run.notes
