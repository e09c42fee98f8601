"""The substep follows the fastest mode of the model in filter and FMUs; unstable models give a message."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from cosim.core.errors import InputError
from cosim.fmi.building.file import LoadedModel, load_model
from cosim.fmi.building.substep import MAX_CHOSEN, with_substep
from cosim.logs.log import read_log
from cosim.model import Model
from cosim.refinement.workflow import refine
from tests.motor import motor_file, motor_log

WINDING = 578.0  # [1/s], eigenvalue of the winding beside that of the shaft


def motor(folder: Path, **changes: str) -> LoadedModel:
    return load_model(f"{motor_file(folder, **changes)}:Motor", Path())


def message_of(call: Callable[[], object]) -> str:
    with pytest.raises(InputError) as caught:
        call()
    (fault,) = caught.value.faults
    return str(fault)


def test_the_default_substep_follows_a_fast_winding(tmp_path: Path) -> None:
    loaded, said = with_substep(motor(tmp_path))
    substep = loaded.model.substep
    assert 0.8 * MAX_CHOSEN <= substep * WINDING <= MAX_CHOSEN  # no shorter than it must be
    rows = loaded.model.rate / substep
    assert rows == pytest.approx(round(rows), abs=1e-9)  # a whole part of the rate
    assert "0.833" in said[0]  # ms, what is chosen


@pytest.mark.parametrize(("stated", "inductance"), [("0.0045", "2.04e-3"), ("", "0.1"), ("0.0001", "1e-4")])
def test_a_substep_that_is_stated_and_stable_however_short_or_a_default_that_suits_is_kept(
    tmp_path: Path, stated: str, inductance: str
) -> None:
    loaded = motor(tmp_path, stated=stated, inductance=inductance)
    assert with_substep(loaded) == (loaded, [])


def test_a_stated_substep_that_is_unstable_is_refused_with_its_cure(tmp_path: Path) -> None:
    said = message_of(lambda: with_substep(motor(tmp_path, stated="0.005")))
    line = 1 + (tmp_path / "motor.py").read_text().splitlines().index("    substep = 0.005")
    assert f"motor.py:{line}:" in said
    assert "1.73" in said  # ms, 1/578 s


def test_a_model_that_needs_more_than_a_hundred_substeps_of_rk4_is_refused_with_its_cure(tmp_path: Path) -> None:
    assert "current" in message_of(lambda: with_substep(motor(tmp_path, inductance="1e-4", integrator="rk4")))


def test_a_mode_that_is_fast_on_the_way_only_counts(tmp_path: Path) -> None:
    """A winding that saturates: at the start it is slow, at the current of the log fast."""
    file = motor_file(tmp_path)
    text = file.read_text().replace("/ self.inductance", "* (0.02 + current * current) / self.inductance")
    file.write_text(text)
    loaded = load_model(f"{file}:Motor", Path())
    assert with_substep(loaded)[1] == []
    log = read_log(motor_log(tmp_path / "a.csv", 1), loaded.model.inputs, loaded.model.outputs)
    chosen, (said,) = with_substep(loaded, [log])
    assert "s of a.csv" in said  # where it was fast
    assert chosen.model.substep < Model.substep


def test_a_model_that_runs_away_is_told_with_its_log_and_time(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """dx/dt = x·exp(5x²) from 8 m ends at once; the stated substep is not to blame, for no mode decays."""
    (tmp_path / "runaway.py").write_text(RUNAWAY)
    rows = [f"{0.02 * k:.2f},{math.sin(k):.4f},{8 + 0.01 * math.cos(7 * k):.4f}" for k in range(300)]
    (tmp_path / "a.csv").write_text("\n".join(["time,u,x", *rows]) + "\n")
    (tmp_path / "study.yaml").write_text("model: runaway.py:Runaway\nlogs: {estimation: [a.csv]}\n")
    assert "a.csv" in message_of(lambda: refine(tmp_path / "study.yaml", tmp_path / "out"))
    assert not list((tmp_path / "out").glob("*"))
    assert capfd.readouterr().out == ""


RUNAWAY = '''
from dataclasses import dataclass

from cosim.model import Equations, Model, Quantity, parameter


@dataclass(frozen=True, kw_only=True)
class Runaway(Model):
    """ẋ = x·exp(a·x²) + u."""

    base_states = (Quantity("x", "m", "position"),)
    inputs = (Quantity("u", "m/s", "speed"),)
    outputs = base_states
    sensor_variance = {"x": 1e-4}
    forced = ("x",)
    calibrated = ("a",)
    substep = 0.005
    a: float = parameter(5.0, unit="1/m2", bounds=(0, 1e9), doc="growth")

    def equations(self, m):
        return Equations(lambda t, x, u: (m.exp(self.a * x[0] * x[0]) * x[0] + u[0],), lambda t, x, u: x)
'''
