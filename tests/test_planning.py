"""What is decided before a run: what fits what, how long and how finely, start values, events, and what it may cost."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cosim.authoring import parts
from cosim.authoring.matching import match_ports, similarity
from cosim.authoring.parts import RequestedTimes, component_name, times_of
from cosim.base.errors import Fault, InputError, SimulationError
from cosim.blocks.component import Signal
from cosim.scenario.diagnosis import LONGEST, Diagnosis
from cosim.scenario.pinned import sha256, with_files_beside
from cosim.scenario.scenario import Criterion, Scenario
from cosim.scenario.start_values import Misfit, convert_value, settable, with_elements
from cosim.simulation.coupling import CouplingError, differences
from cosim.simulation.criteria import evaluate, sentence
from cosim.storage.results import Results
from cosim.storage.yaml_file import MOST_FAULTS
from cosim.sweeps.sampling import drawn_rows, saltelli_base
from cosim.system import system as built
from cosim.system.wiring import Transfer, lay_out, through
from tests.own_blocks import Block
from tests.test_schedule import Noted

# -- names ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("a", "b", "value"),
    [
        ("speed", "speed", 1.0),
        ("motor_speed", "speed", 0.875),  # one word of two: 0.75 + 0.25/2
        ("motorSpeed", "speed_motor", 1.0),
        ("temp", "temperature", 0.8),
        ("u_in", "u_out", 1.0),  # in and out say nothing
        ("y1", "y2", 0.5),
        ("speed", "speed_ref", 0.0),  # a reference is no measurement
        ("", "speed", 0.0),
        ("RPMMotor", "rpm", 0.875),
    ],
)
def test_names_are_alike_by_their_words(a: str, b: str, value: Any) -> None:
    assert similarity(a, b) == similarity(b, a) == value


def port(owner: str, name: str, unit: str = "", **more: Any) -> tuple[str, Signal]:
    return owner, Signal(name, unit, kind="Real", **more)


def pairs(outputs: Any, inputs: Any, sizes: Any = None) -> dict[str, str]:
    found = match_ports(outputs, inputs, sizes or {})
    return {f"{m.target[0]}.{m.target[1].name}": f"{m.source[0]}.{m.source[1].name}" for m in found.connections}


def test_an_input_is_fed_by_the_output_of_its_name_of_another_component() -> None:
    outputs = [port("a", "x"), port("b", "x"), port("a", "y")]
    assert pairs(outputs, [port("b", "x")]) == {"b.x": "a.x"}
    found = match_ports(outputs, [port("c", "x")])
    assert found.connections == ()
    assert found.choices == {"c.x": ("a.x", "b.x")}
    assert found.unconnected == ((port("c", "x"), ("a.x", "b.x", "a.y")),)


def test_a_like_name_of_one_unit_goes_before_one_of_another() -> None:
    target = [port("c", "motor_speed", "rad/s")]
    assert pairs([port("p", "speed", "rad/s"), port("p", "velocity", "rad/s")], target) == {"c.motor_speed": "p.speed"}
    assert pairs([port("p", "speed", "V"), port("p", "spd", "rad/s")], target) == {"c.motor_speed": "p.spd"}
    (match,) = match_ports([port("p", "speed", "rad/s")], target).connections
    assert match.guess == "similar name, same unit"
    (match,) = match_ports([port("p", "speed")], target).connections
    assert match.guess == "similar name"
    deg = match_ports([port("p", "angle", "deg")], [port("c", "angle", "rad")]).connections[0]
    assert deg.factor == (pytest.approx(math.pi / 180), 0.0)


def test_each_output_goes_once_unless_it_is_of_that_name() -> None:
    outputs = [port("p", "speed", "m/s"), port("p", "force", "N")]
    inputs = [port("a", "speed", "m/s"), port("b", "speed", "m/s"), port("c", "force_in", "N")]
    assert pairs(outputs, inputs) == {"a.speed": "p.speed", "b.speed": "p.speed", "c.force_in": "p.force"}
    alone = match_ports([port("p", "alpha", "N")], [port("c", "omega", "N")])
    assert alone.connections[0].guess == "nothing else is left that fits"
    both = match_ports([port("p", "alpha", "N")], [port("c", "omega", "N"), port("d", "zeta", "N")])
    assert both.connections == ()


def test_arrays_go_to_arrays_of_as_many_elements() -> None:
    outputs, inputs = [port("p", "x[1]", array="x")], [port("c", "x[1]", array="x")]
    assert pairs(outputs, inputs, {"p.x": 3, "c.x": 3}) == {"c.x[1]": "p.x[1]"}
    assert pairs(outputs, inputs, {"p.x": 3, "c.x": 2}) == {}


@pytest.mark.parametrize(
    ("stem", "model", "name"),
    [
        ("Motor v2.1", "", "Motor_v2_1"),
        ("Größe", "", "Groesse"),
        ("3d", "", "fmu_3d"),
        ("--", "", "fmu"),
        ("a" * 24, "x", "a" * 24),
        ("a" * 25, "lib.Short", "Short"),
        ("a" * 25, "", "a" * 24),
        ("abcdefgh_ijklmnop_qrstuvw_xyz", "", "abcdefgh_ijklmnop"),
        ("abcdefghij_klmnopqrstuvwxyzabc", "", "abcdefghij_klmnopqrstuvw"),
        ("abcdefghijkl_mnopqrstuvwxyzabc", "", "abcdefghijkl"),
    ],
)
def test_a_component_is_called_by_its_file_in_24_letters(stem: str, model: str, name: str) -> None:
    assert component_name(stem, model) == name
    assert len(name) <= 24


# -- how long and how finely ------------------------------------------------------------------------


def planned(monkeypatch: pytest.MonkeyPatch, *experiments: dict[str, float], own: Any = None, **asked: Any) -> Any:
    listed = [SimpleNamespace(name=f"p{k}", path=Path(f"p{k}.fmu"), description=e) for k, e in enumerate(experiments)]
    monkeypatch.setattr(parts, "experiment_of", lambda description: description)
    monkeypatch.setattr(parts, "_own_step", lambda part: (own or {}).get(part.name, 0.0))
    most = {"most": asked.pop("most")} if "most" in asked else {}
    return times_of(listed, RequestedTimes(**asked) if asked else None, **most)  # type: ignore[arg-type]


def test_a_run_is_that_of_the_longest_experiment_in_the_finest_step(monkeypatch: pytest.MonkeyPatch) -> None:
    found = planned(monkeypatch, {"start": 1.0, "stop": 3.0, "step": 0.1}, {"start": 0.0, "stop": 9.0, "step": 0.5})
    assert (found.start, found.duration, found.step) == (0.0, 9.0, 0.1)
    assert found.why_duration == "the default experiment of p1"
    assert found.why_step == "the step of p0"
    none = planned(monkeypatch, {}, {"start": 5.0, "stop": 5.0})
    assert (none.start, none.duration, none.step) == (0.0, 5.0, 0.01)
    guess = planned(monkeypatch, {})
    assert (guess.start, guess.duration, guess.step, guess.notes) == (0.0, 1.0, 0.002, ())


@pytest.mark.parametrize(
    ("wish", "step"), [(0.002, 0.002), (0.0019, 0.001), (0.005, 0.005), (0.0499, 0.02), (9.99, 5.0)]
)
def test_a_guessed_step_is_round(wish: float, step: float) -> None:
    assert parts._round(wish) == step


def test_an_end_that_is_asked_for_is_kept_and_else_the_step(monkeypatch: pytest.MonkeyPatch) -> None:
    found = planned(monkeypatch, {"stop": 9.0, "step": 0.3}, stop=1.0)
    assert (found.duration, found.step) == (1.0, 0.25)
    assert found.notes == ("the step is 0.25 s, not 0.3 s (the step of p0), to end at 1 s",)
    kept = planned(monkeypatch, {"stop": 9.0}, stop=1.0, step=0.3)
    assert (kept.duration, kept.step) == (1.2, 0.3)
    assert kept.notes[0].startswith("the run ends at 1.2 s, not at 1 s (given)")
    own = planned(monkeypatch, {"stop": 9.0}, own={"p0": 0.3}, stop=1.0)
    assert (own.duration, own.step, own.own) == (1.2, 0.3, {})
    exact = planned(monkeypatch, {"stop": 9.0}, stop=0.9, step=0.3)
    assert (exact.duration, exact.notes) == (0.9, ())
    several = planned(monkeypatch, {"step": 0.1}, {"stop": 2.0}, own={"p1": 0.5}, stop=1.0)
    assert (several.step, several.own) == (0.1, {"p1": 0.5})


def test_a_first_run_is_of_so_many_steps_at_most_and_a_step_is_no_longer_than_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = planned(monkeypatch, {"stop": 100.0, "step": 1.0}, most=40)
    assert (found.duration, found.step) == (40.0, 1.0)
    assert found.why_duration == "40 steps; the default experiment of p0 would be 100 s"
    assert planned(monkeypatch, {"stop": 40.0, "step": 1.0}, most=40).duration == 40.0
    assert planned(monkeypatch, {"stop": 9.0}, usual_step=0.5).step == 0.5
    assert planned(monkeypatch, {"stop": 0.25}, usual_step=0.5).step == 0.25
    assert planned(monkeypatch, {"stop": 2.0}, step=2.0).step == 2.0
    with pytest.raises(InputError, match=r"--step 2\.1: is longer than the run, 2 s"):
        planned(monkeypatch, {"stop": 2.0}, step=2.1)


# -- start values -----------------------------------------------------------------------------------


def variable(kind: str = "Real", **more: Any) -> Any:
    default = {
        "name": "v", "type": kind, "shape": (), "causality": "parameter", "variability": "fixed", "initial": "exact",
        "start": "0", "min": None, "max": None, "declaredType": None, "unit": None, "relativeQuantity": None,
    }  # fmt: skip
    return SimpleNamespace(**(default | more))


def fits(given: Any, kind: str = "Real", version: str = "2.0", **more: Any) -> Any:
    found = convert_value(SimpleNamespace(fmiVersion=version, unitDefinitions=[]), variable(kind, **more), given)
    return found.reason if isinstance(found, Misfit) else found


@pytest.mark.parametrize(
    ("given", "kind", "more", "found"),
    [
        (2, "Real", {}, 2.0),
        (2.0, "Integer", {}, 2),
        (2.5, "Integer", {}, "it is a whole number"),
        (math.nan, "Integer", {}, "it is a whole number"),
        (math.inf, "Integer", {}, "it is a whole number"),
        (True, "Real", {}, "it is a number [1]"),
        (1, "Boolean", {}, "it is true or false"),
        (True, "Boolean", {}, True),
        (1, "String", {}, "it is text"),
        (5.0, "Real", {"min": "1", "max": "5"}, 5.0),
        (1.0, "Real", {"min": "1", "max": "5"}, 1.0),
        (5.1, "Real", {"min": "1", "max": "5"}, "it lies in [1, 5]"),
        (0.9, "Real", {"min": "1"}, "it lies in [1, inf]"),
        (2**31, "Integer", {}, "it lies in [-2.14748e+09, 2.14748e+09]"),
        (2**31 - 1, "Integer", {}, 2**31 - 1),
        ([1, 2], "Real", {"shape": (2,)}, [1.0, 2.0]),
        ([1], "Real", {"shape": (2,)}, "it is a list of 2 values"),
        ([1, "x"], "Real", {"shape": (1, 2)}, "it is a number alone: no unit of it is declared"),
        ("180 deg", "Real", {"unit": "rad"}, pytest.approx(math.pi)),
        ("1 m", "Real", {}, "it is a number alone: no unit of it is declared"),
    ],
)
def test_a_start_value_is_of_the_type_within_the_bounds(given: Any, kind: str, more: Any, found: Any) -> None:
    assert fits(given, kind, **more) == found


def test_items_of_an_enumeration_go_by_name_or_number() -> None:
    items = [SimpleNamespace(name=name, value=value) for name, value in (("off", "1"), (None, "2"), ("on", "3"))]
    more = {"declaredType": SimpleNamespace(items=items, min=None, max=None, unit=None, relativeQuantity=None)}
    assert fits("on", "Enumeration", **more) == 3
    assert fits(1, "Enumeration", **more) == 1
    assert fits(2, "Enumeration", **more) == "it is one of off (1), on (3)"
    assert fits("of", "Enumeration", **more).startswith("it is one of off, on")


def test_elements_of_an_array_are_put_into_its_list() -> None:
    array = variable(name="A", shape=(2, 2), start="1 2 3 4")
    of = {"A": array, "b": variable(name="b")}
    assert with_elements({"A[1,2]": 9}, of) == {"A": [1, 9, 3, 4]}
    assert with_elements({"A[1,2]": 9, "A[2,2]": 8, "b": 1}, of) == {"A": [1, 9, 3, 8], "b": 1}
    assert with_elements({"A": [5, 5, 5, 5], "A[1,1]": 9}, of) == {"A": [9, 5, 5, 5]}
    assert with_elements({"A[1,1]": 9}, {"A": variable(name="A", shape=(2, 2), start="7")}) == {"A": [9, 7, 7, 7]}
    assert with_elements({"A[1,1]": 9}, {"A": variable(name="A", shape=(2, 2), start=None)}) == {"A": [9, 0, 0, 0]}
    assert with_elements({"A[3,1]": 9, "b[1]": 2}, of) == {"A[3,1]": 9, "b[1]": 2}


def test_what_fmi_lets_a_host_set() -> None:
    assert settable(variable())
    assert settable(variable(initial="approx", causality="output"))
    assert settable(variable(initial="calculated", causality="input"))
    assert settable(variable(initial=None, start="1", causality="local"))
    assert not settable(variable(initial=None, start=None, causality="local"))
    assert not settable(variable(initial="calculated"))
    assert not settable(variable(variability="constant"))
    assert not settable(variable(causality="independent"))


# -- criteria ---------------------------------------------------------------------------------------


def evaluated(kind: str, **more: Any) -> dict[str, Any]:
    time = 10.0 + np.arange(5.0)
    signals = np.column_stack([[4.0, -2.0, 1.0, 1.0, 3.0], [1.0, 1.0, 1.0, 1.0, 1.0]])
    results = Results(time, ("a.y", "a.r"), signals, {"a.y": "m"})
    criterion = Criterion.model_validate({"of": "a.y", "max": 2.0} | more)
    (found,) = evaluate(SimpleNamespace(goals=[(kind, 0, criterion)], step=1.0), results)  # type: ignore[arg-type]
    return found


@pytest.mark.parametrize(
    ("kind", "more", "value", "unit"),
    [
        ("peak", {}, 4.0, "m"),
        ("peak", {"to": 1.0}, 3.0, "m"),
        ("peak", {"to": "a.r", "after": 1.0}, 3.0, "m"),
        ("peak", {"after": 2.0}, 3.0, "m"),
        ("peak", {"after": 2.0, "until": 3.0}, 1.0, "m"),
        ("peak", {"until": 0.0}, 4.0, "m"),
        ("final_error", {"to": 1.0}, 2.0, "m"),
        ("final_error", {"to": 1.0, "until": 3.0}, 0.0, "m"),
        ("rms_error", {"to": 1.0, "after": 1.0}, math.sqrt((9 + 4) / 4), "m"),
        ("effort", {}, 8.0, "m.s"),
        ("settling_time", {"to": 1.0, "band": 0.5, "until": 3.0}, 1.0, "s"),
        ("settling_time", {"to": 1.0, "band": 0.5}, None, "s"),
        ("overshoot", {"to": 1.0, "until": 3.0}, 3.0, "m"),
    ],
)
def test_a_criterion_is_judged_within_its_times(kind: str, more: Any, value: Any, unit: str) -> None:
    found = evaluated(kind, **more)
    assert (found["value"], found["unit"]) == (value if value is None else pytest.approx(value), unit)
    assert found["met"] is (value is not None and value <= 2.0)


def test_a_criterion_that_is_met_exactly_is_met_and_the_sentence_says_both_numbers() -> None:
    met = evaluated("final_error", to=1.0)
    assert met["met"]
    assert sentence(met) == "met: final error of a.y is 2 m, at most 2 m allowed"
    missed = evaluated("peak", after=1.0, until=4.0)
    assert sentence(missed) == "MISSED: peak of a.y after 1 s until 4 s is 3 m, at most 2 m allowed"
    never = evaluated("settling_time", to=1.0, band=0.5)
    assert sentence(never) == "MISSED: settling time of a.y is never, at most 2 s allowed"


# -- wiring -----------------------------------------------------------------------------------------


def test_a_value_passes_unit_noise_and_faults_in_this_order() -> None:
    assert Transfer(0, 1, "a.u").plain
    assert Transfer(0, 1, "a.u").through(1, 0.0, 0.1, 3) == ()
    for more in ({"factor": 2.0}, {"offset": 1.0}, {"items": {"on": 1}}, {"beside": (True, True)}):
        assert not Transfer(0, 1, "a.u", **more).plain  # type: ignore[arg-type]
    chain = Transfer(0, 1, "a.u", factor=2.0, offset=-1.0).through(1, 0.0, 0.1, 3)
    assert [one(0, 5.0) for one in chain] == [9.0]
    assert len(Transfer(0, 1, "a.u", offset=1.0).through(1, 0.0, 0.1, 3)) == 1
    assert through(chain)(0, 5.0) == 9.0
    assert through((*chain, *chain))(0, 5.0) == 17.0


def test_a_value_that_is_no_item_is_told_with_the_time_at_which_it_came() -> None:
    items = {"off": 1, "on": 3}
    (check,) = Transfer(0, 1, "b.mode", items=items, origin="a.y").through(1, 2.0, 0.5, 9)
    assert (check(0, 7.0), check(4, 3.0)) == (7.0, 3.0)  # what is there before initialization has ended is not judged
    with pytest.raises(
        SimulationError, match=r"b\.mode at t = 4 s: 2, which comes from a\.y, is none of its items: off 1, on 3"
    ):
        check(4, 2.0)


def test_signals_stand_in_the_row_component_after_component_inputs_first() -> None:
    a, b = Block("a", ["u"], ["y"], lambda t, h, u: u), Block("b", ["v"], ["z"], lambda t, h, u: u)
    b.exact_outputs = (Signal("text"),)
    layout = lay_out({"a": a, "b": b})  # type: ignore[dict-item]
    assert layout.columns == ("a.u", "a.y", "b.v", "b.z")
    assert layout.beside == ("b.text",)
    assert (layout.place["b.v"], layout.place["b.text"]) == ((False, 2), (True, 0))


# -- what no run can give ---------------------------------------------------------------------------


def test_results_of_more_than_eight_gigabytes_are_refused() -> None:
    for rows, told in ((1e8 - 1, False), (1e8, True)):  # of ten signals of eight bytes
        noted: Any = Noted()
        noted.file = SimpleNamespace(scenario=SimpleNamespace(duration=0.001 * rows, step=0.001))
        built._check_size(10, noted)
        assert bool(noted.faults) is told
    assert noted.faults[0][1].startswith("leaves 1e+08 rows of 10 signals, 8 GB, more than 8 GB")


def test_a_very_long_message_is_cut_and_very_many_faults_end_the_search() -> None:
    def fault(where: Any, message: str, exit_code: int = 2) -> Any:
        return Fault(Path("a.yaml"), len(message), 1, message, exit_code)

    file: Any = SimpleNamespace(faults=[], warnings=[], fault=fault, path=Path("a.yaml"))
    diagnosis = Diagnosis(file)
    diagnosis.raise_any()
    for length in (LONGEST, LONGEST + 1):
        diagnosis.note((), "x" * length)
        assert len(diagnosis.faults[-1].message) == LONGEST
    assert diagnosis.faults[-2].message[-1] == "x"
    assert diagnosis.faults[-1].message[-1] == "…"
    for k in range(MOST_FAULTS - 3):
        diagnosis.note((), "y" * k)
    with pytest.raises(InputError) as raised:
        diagnosis.note((), "the last")
    assert len(raised.value.faults) == MOST_FAULTS + 1
    assert any("faults are shown" in f.message for f in raised.value.faults)
    with pytest.raises(InputError):
        diagnosis.raise_any()


# -- files of a run that is repeated ----------------------------------------------------------------


def test_a_file_of_the_run_is_taken_from_beside_the_manifest_where_it_is_no_more_or_another(tmp_path: Path) -> None:
    (tmp_path / "was").mkdir()
    (tmp_path / "was" / "log.csv").write_text("the run's")
    pinned = sha256(tmp_path / "was" / "log.csv")

    def taken(there: str | None, beside: str | None) -> str:
        for path, content in ((tmp_path / "was" / "log.csv", there), (tmp_path / "log.csv", beside)):
            path.unlink(missing_ok=True)
            if content is not None:
                path.write_text(content)
        component = {"block": "playback", "file": "was/log.csv", "sha256": pinned}
        scenario = Scenario.model_validate({"name": "n", "duration": 1, "step": 0.1, "components": {"a": component}})
        return with_files_beside(scenario, tmp_path).components["a"].file  # type: ignore[union-attr]

    assert taken("the run's", "the run's") == "was/log.csv"
    assert taken(None, "the run's") == "log.csv"
    assert taken(None, "another") == "log.csv"
    assert taken("another", "the run's") == "log.csv"
    assert taken("another", "another still") == "was/log.csv"
    assert taken("another", None) == "was/log.csv"


# -- the coupling error -----------------------------------------------------------------------------


def test_a_coupling_error_is_the_largest_difference_where_both_runs_have_a_row() -> None:
    def run(step: float, rows: int, scale: float, names: tuple[str, ...] = ("a.y", "a.x[1]", "a.z")) -> Results:
        time = step * np.arange(rows)
        return Results(time, names, np.column_stack([scale * time**2] * len(names)))

    whole, halved = run(0.1, 6, 1.0), run(0.05, 11, 0.5)
    assert differences(whole, halved, ["a.y", "a.x"]) == pytest.approx({"a.y": 0.125, "a.x[1]": 0.125})
    # one that ended at 0.25 s has a row at 0.2 s in common
    assert differences(whole, run(0.05, 6, 0.5), ["a.y"]) == pytest.approx({"a.y": 0.02})


def test_the_sentence_of_a_coupling_error_says_what_is_known() -> None:
    assert CouplingError({}, "it crashed").sentence == "coupling error not known: with half the step it crashed"
    assert CouplingError({}).sentence == "half the step changes at most nothing, for nothing is connected"
    base = "half the step changes at most a.y 0.12, b.y 3; the coupling error is about twice that"
    of = {"a.y": 0.123, "b.y": 3.0}
    assert CouplingError(of).sentence == base
    assert CouplingError(of, without="why").sentence == f"{base}; of single steps not known: why"
    single = CouplingError(of, steps={"a.y": (0.0456, 1.5)}).sentence
    assert single == f"{base}; of a single step, taken back and made again in halves: a.y 0.046 at t = 1.5 s"


# -- the design of a sweep --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("runs", "count", "base"),
    [(4, 2, 1), (3, 2, 0), (7, 2, 1), (8, 2, 2), (100, 3, 16), (0, 1, 0), (80, 3, 16), (79, 3, 8)],
)
def test_saltelli_takes_the_largest_power_of_two_that_fits(runs: int, count: int, base: int) -> None:
    assert saltelli_base(runs, count) == base
    assert drawn_rows(count, False, runs, "saltelli") == base * (count + 2) <= runs
    assert drawn_rows(0, True, runs, "saltelli") == runs
    assert drawn_rows(0, False, runs, "sobol") == 1


def test_a_value_just_above_its_limit_does_not_look_like_it() -> None:
    outcome = {"kind": "step_error", "of": "k.f", "unit": "", "max": 1e-4, "met": False}
    assert sentence({**outcome, "value": 1.00001e-4}).endswith("is 0.000100001, at most 0.0001 allowed")
    assert sentence({**outcome, "value": 0.123456}).endswith("is 0.1235, at most 0.0001 allowed")
    assert sentence({**outcome, "value": None}).endswith("is never, at most 0.0001 allowed")
