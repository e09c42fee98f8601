"""FMUs that misbehave, through `cosim fit` and the studies of `cosim refine`: handled or refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import cosim
from cosim.core.errors import InputError, TimedOut
from cosim.estimation.subject.fmu_subject import FmuSubject
from cosim.refinement.study import read_study
from tests.blind.fmu_build import WAYS, build
from tests.cases import some
from tests.test_refine_fmu import NOISE, RESISTANCE, run_motor, write_study

STEPS = ("co_simulation",)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bad")
    for k, name in enumerate(("a", "b")):
        run_motor(folder / f"{name}.csv", k, seconds=4.0)
    return folder


def motor(folder: Path, fault: str, ways: tuple[str, ...] = STEPS) -> Path:
    """Return a motor that misbehaves."""
    return build(folder / f"{fault}_{len(ways)}.fmu", "dc_motor", ways=ways, fault=fault)


def fitted(folder: Path, fault: str, first: float = 1.0) -> float:
    """Return the fit of the resistance from a first value."""
    vary, start, out = ["resistance=0.5..3 ohm"], [f"resistance={first}"], folder / f"out_{fault}"
    fit = cosim.fit([folder / "a.csv"], motor(folder, fault), out, vary=vary, start=start, report=False)
    return fit.values["resistance"]


@pytest.mark.parametrize(
    "fault", some(["forgets_parameters", "idle_reset", "leaks", "counts", "clock", "crashes", "hangs"], every=7)
)
def test_a_misbehaving_fmu_is_fitted_all_the_same(folder: Path, fault: str) -> None:
    near = fault in {"crashes", "hangs"}  # it fails above 1.05 times the true value
    found = fitted(folder, fault, RESISTANCE if near else 1.0)
    assert found == pytest.approx(RESISTANCE, rel=0.01 if fault == "forgets_parameters" else 0.05)  # faults of 1, 5 %


def test_a_step_above_that_of_the_log_is_refused(folder: Path) -> None:
    with pytest.raises(InputError) as refused:
        fitted(folder, "hidden_own_step")
    assert [fault.exit_code for fault in refused.value.faults] == [2]
    assert not (folder / "out_hidden_own_step" / "fit.json").exists()
    with pytest.raises(InputError) as refused:
        read_study(write_study(folder, motor(folder, "hidden_own_step"), [folder / "a.csv"], noise=NOISE))
    assert [(fault.exit_code, fault.line) for fault in refused.value.faults] == [(2, 1)]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("fault", "way"),
    [
        ("step_events", "co-simulation"),
        ("time_events", "co-simulation"),
        ("hidden_own_step", "model-exchange"),
        ("forgets_parameters", "model-exchange"),
    ],
)
def test_a_study_takes_the_interface_that_works(folder: Path, fault: str, way: str) -> None:
    study = read_study(write_study(folder, motor(folder, fault, WAYS), [folder / "a.csv"], noise=NOISE))
    assert isinstance(study.subject, FmuSubject)
    assert study.subject.structure.way == way
    assert any("steps of its own" in text for text in study.warnings) == (fault == "hidden_own_step")


@pytest.mark.thorough
def test_a_crash_costs_one_candidate_and_is_named_with_its_call(folder: Path, tmp_path: Path) -> None:
    fmu = motor(folder, "crashes", ("model_exchange",))
    file = write_study(
        folder, fmu, [folder / "a.csv", folder / "b.csv"], noise=NOISE, candidates=["resistance", "bias_at_speed"]
    )
    refined = cosim.refine(file, tmp_path, report=False)
    assert refined.verdict == "no_effect"
    assert any("the FMU failed in" in w and "crashed" in w for w in refined.record["warnings"])


def test_the_time_limit_of_a_study_ends_its_search(folder: Path, tmp_path: Path) -> None:
    fmu = motor(folder, "crashes", ("model_exchange",))
    file = write_study(folder, fmu, [folder / "a.csv"], noise=NOISE, limits={"total": "1 ms"})
    with pytest.raises(TimedOut, match=r"the limit of 0\.001 s \(limits: total\) is reached at"):
        cosim.refine(file, tmp_path / "out", report=False)
    record = json.loads((tmp_path / "out" / "refine.json").read_text(encoding="utf-8"))
    assert record["finished"] is False
    assert "verdict" not in record
