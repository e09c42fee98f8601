"""Each verdict's sentence against its own numbers: sentences as they are made agree, and what does not is noticed."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cosim.base.text import percent
from cosim.estimation.fit import Fit
from cosim.estimation.noise_model import Noise
from cosim.refinement.decision.claims import Claims, Doubt, Improvement, MovedParameter, Nearest
from cosim.refinement.decision.sentences import (
    claim_text,
    doubt_text,
    floor_warning,
    further_text,
    little_excitation_text,
    missed_channel_text,
    nearest_improvement_text,
    nearest_text,
    no_effect_text,
    part_text,
    remainder_text,
    rise_text,
    rivals_text,
    sentence,
    small_gains_text,
    unexplained_text,
)
from cosim.refinement.proof.measure import Floor
from cosim.refinement.record import effects, hidden_effects
from cosim.refinement.search.hypotheses import Attribution, Hypothesis, Support
from cosim.refinement.search.unnamed import UnnamedTerm
from cosim.refinement.workflow import _floor_warnings
from cosim.subject.candidates import Candidate, Free
from cosim.subject.model_subject import ModelSubject
from plant.hovercraft import Hovercraft
from tests.verdicts import contradictions

CRAFT = Hovercraft()
FORCE = Free("coulomb_friction.force", 0.0, 1.0, 0.01, neutral=0.0)
DRAG = Free("quadratic_drag.coefficient", 0.0, 10.0, 0.5, neutral=0.0)
MASS = Free("mass", 0.1, 10.0, 0.05)
KINDS = {"coulomb_friction": (FORCE, "effect"), "quadratic_drag": (DRAG, "effect"), "mass": (MASS, "parameter")}
VALUES = {FORCE.name: 0.0612, DRAG.name: 0.447, MASS.name: 0.8123}
UNITS = {"vx": "m/s", "psi": "rad"}


def fitted(*names: str) -> Hypothesis:
    """A hypothesis of these candidates, each known to a hundredth."""
    parts = tuple(Candidate(n, KINDS[n][1], (KINDS[n][0],), ()) for n in names)  # type: ignore[arg-type]
    free = tuple(KINDS[n][0] for n in names)
    information = np.diag([(0.01 * VALUES[f.name]) ** -2 for f in free])
    fit = Fit(VALUES, Noise(np.zeros(1), 0.0, np.zeros(1), np.zeros(1)), free, (0.0,), 0.0, information, 5, True)
    return Hypothesis(parts, fit, -100.0)


def many_parameters() -> Hypothesis:
    """A hypothesis of every effect of the craft that has several parameters."""
    parts = tuple(c for c in ModelSubject.of(CRAFT).candidates(()) if len(c.free) > 1)
    free = tuple(f for c in parts for f in c.free)
    values = {f.name: (f.neutral or 0.0) + 0.5 * f.size for f in free}
    noise = Noise(np.zeros(1), 0.0, np.zeros(1), np.zeros(1))
    fit = Fit(values, noise, free, (0.0,), 0.0, np.diag([1e4 / f.size**2 for f in free]), 5, True)
    assert len(parts) > 3
    return Hypothesis(parts, fit, -100.0)


def errors(before: float, after: float, near: float | None = None) -> dict[str, Any]:
    sizes = {"before": before, "recalibrated": 0.9 * before, "after": after, "nearest": near}
    return {k: None if v is None else {"estimation": {"vx": v}, "validation": {"vx": v}} for k, v in sizes.items()}


def written(
    verdict: str, sentence: str, grade: str, h: Hypothesis | None = None, near: tuple[str, ...] = (), **more: Any
) -> dict[str, Any]:
    """As refine.json has it; floors of 0.01, an error before of 0.1."""
    entries = [e.model_dump(mode="json") for e in effects(ModelSubject.of(CRAFT), h, ())] if h else []
    after = 0.0101 if h else 0.1
    if grade != "claimed":
        sentence = f"{sentence} {nearest_text(near, fitted=bool(near))}"
    ranked = [{"names": list(h.names), "why": "claimed", "score_gain": 200.0}] if h else []
    floors: dict[str, Any] = {part: {"vx": 0.01} for part in ("estimation", "validation")}
    record = {
        "verdict": verdict, "sentence": sentence, "grade": grade, "effects": entries, "rivals": [], "experiment": "",
        "nearest": list(near), "candidates": ranked, "hidden": [], "warnings": [],
        "residual": {"equation": None, "signals": [], "share": None, "terms": []},
        "error": errors(0.1, after, None if grade == "claimed" else 0.1 if not near else 0.05),
        "noise_floor": floors["validation"], "noise_floors": floors,
        "floor_scatters": {part: {"vx": 0.05} for part in floors},
    }  # fmt: skip
    return record | more


def found(*names: str) -> dict[str, Any]:
    h = fitted(*names)
    return written("effect_found", claim_text(h, h.candidates, ModelSubject.of(CRAFT)), "claimed", h)


def in_part() -> dict[str, Any]:
    h = fitted("coulomb_friction")
    residual = {"equation": "vx", "signals": ["x_world"], "share": 0.3, "terms": [{"gain": 30.0}]}
    left = (0.05**2 - 0.01**2) / (0.1**2 - 0.01**2)
    kept = part_text(residual, f"replays keep {percent(left)} of the excess error of vx")
    sentence = f"{claim_text(h, h.candidates, ModelSubject.of(CRAFT))} {kept}"
    near = ("coulomb_friction", "quadratic_drag")
    return written("effect_found", sentence, "part", h, near, residual=residual, error=errors(0.1, 0.05, 0.04))


def outside_the_catalogue(share: float | None = 0.42) -> dict[str, Any]:
    residual = {"equation": "vx", "signals": ["x_world"], "share": share, "terms": [{"gain": 30.0}]}
    left = Improvement({"vx": (0.05**2 - 0.01**2) / (0.09**2 - 0.01**2)}, "recalibrated")
    opening = nearest_improvement_text(left, Nearest(fitted("coulomb_friction")))
    sentence = f"{opening} {unexplained_text(residual, ['coulomb_friction'])}"
    return written("unexplained", sentence, "nearest", None, ("coulomb_friction",), residual=residual)


def open_question() -> dict[str, Any]:
    h, experiment = fitted("mass", "coulomb_friction"), "both duties varied"
    names = ["coulomb_friction", "quadratic_drag"]
    certain = [c for c in h.candidates if c.name == "mass"]
    sentence = rivals_text(names, experiment, claim_text(h, certain, ModelSubject.of(CRAFT)))
    shared = [e.model_dump(mode="json") for e in effects(ModelSubject.of(CRAFT), h, (), certain)]
    ranked = [{"names": [n], "why": "a rival: fits best, by little", "score_gain": 200.0} for n in names]
    ranked.append({"names": ["lag"], "why": "no gain", "score_gain": -1.0})
    asked = {"rivals": names, "experiment": experiment, "effects": shared, "candidates": ranked}
    return written("ambiguous", sentence, "part", h, ("mass",), **asked)


def too_little() -> dict[str, Any]:
    names = ["coulomb_friction", "quadratic_drag"]
    experiment = "larger and broader commands on all inputs, one at a time and together"
    sentence = little_excitation_text(len(names), experiment, still=False)
    return written("ambiguous", sentence, "nearest", rivals=names, experiment=experiment, hidden=names)


def only_recalibrated() -> dict[str, Any]:
    sentence = missed_channel_text("vx", 10.0, (), {})
    return written("unexplained", sentence, "nearest", error=errors(0.1, 0.1, 0.1))


def nothing_missing() -> dict[str, Any]:
    hidden = ["coulomb_friction", "quadratic_drag"]
    return written("no_effect", no_effect_text(hidden, {"vx": 0.012}), "nearest", hidden=hidden)


def beside_something() -> dict[str, Any]:
    h = fitted("coulomb_friction")
    term = UnnamedTerm("vx", "x_world", 30.0, 0.1, 30.0)
    sentence = f"{claim_text(h, h.candidates, ModelSubject.of(CRAFT))} {remainder_text(term, 200.0)}"
    return found("coulomb_friction") | {
        "sentence": sentence,
        "residual": {"equation": "vx", "signals": ["x_world"], "share": 0.1, "terms": [{"gain": 30.0}]},
    }


def worse_on_sealed_logs() -> dict[str, Any]:
    record = found("coulomb_friction")
    record["error"]["after"]["validation"] = {"vx": 0.2}
    record["sentence"] = f"{rise_text({'vx': (0.1, 0.2)}, UNITS, 'model.yaml')} {record['sentence']}"
    return record


def below_its_floor() -> dict[str, Any]:
    record = found("coulomb_friction")
    record["error"]["after"]["validation"] = {"vx": 0.005}
    above = Floor({"vx": 0.01}, {"vx": 0.05}).channels_above({"vx": 0.005})
    return record | {"warnings": [floor_warning("validation", above, UNITS)]}


MADE: dict[str, Callable[[], dict[str, Any]]] = {
    "an effect": lambda: found("coulomb_friction"),
    "two effects": lambda: found("coulomb_friction", "quadratic_drag"),
    "a parameter": lambda: found("mass") | {"verdict": "parameter_error"},
    "a part": in_part,
    "outside": outside_the_catalogue,
    "outside, by little": lambda: outside_the_catalogue(0.02),
    "ambiguous": open_question,
    "too little": too_little,
    "only recalibrated": only_recalibrated,
    "nothing": nothing_missing,
    "something left": beside_something,
    "worse on sealed logs": worse_on_sealed_logs,
    "below its floor": below_its_floor,
}


@pytest.mark.parametrize("made", MADE)
def test_a_verdict_agrees_with_its_own_numbers(made: str) -> None:
    assert contradictions(MADE[made]()) == []


MANY = [f"effect_{k}" for k in range(10)]
FAR = [MovedParameter(name, 1.0, 2.0) for name in MANY]
ACTS = {"equation": "vx", "signals": ["x_world"], "share": 0.3, "terms": []}


@pytest.mark.parametrize(
    "text",
    [
        *(make()["sentence"] for make in MADE.values()),
        no_effect_text(MANY, dict.fromkeys(MANY, 0.01)),
        rivals_text(MANY, "both duties varied", ""),
        unexplained_text(ACTS, MANY),
        doubt_text(Doubt("unsteady", names=tuple(MANY)), {}),
        nearest_text(MANY, fitted=True),
        *(
            nearest_improvement_text(Improvement(shares, "recalibrated", is_clear=False), Nearest(h))
            for h in (fitted(*KINDS), fitted(*KINDS, *KINDS), None)
            for shares in ({"vx": 0.5, "psi": 0.6}, {"vx": 1.5})
        ),
        *(doubt_text(Doubt(kind, "vx", 0.3), {}) for kind in ("disturbed", "replaced")),
        missed_channel_text("vx", 10.0, FAR, dict.fromkeys(MANY, "kg")),
        further_text(FAR, dict.fromkeys(MANY, "kg")),
        small_gains_text(MANY),
        rise_text(dict.fromkeys(MANY, (0.1, 0.2)), dict.fromkeys(MANY, "m"), "nearest.yaml"),
        claim_text(wide := many_parameters(), wide.candidates, ModelSubject.of(CRAFT)),
    ],
)
def test_a_sentence_has_at_most_25_words_and_no_chain_of_more_than_three_names(text: str) -> None:
    for one in re.split(r"(?<=\.) (?=[A-Za-z`])", text):
        assert len(one.replace("\u00a0", "").split()) <= 25, one
        assert len(re.findall(r"effect_\d", one)) <= 3, one


@pytest.mark.parametrize(
    ("region", "words"),
    [
        ((0.0, 0.07), "at most 0.07 N"),
        ((0.05, 1.0), "at least 0.05 N"),
        ((0.05, 0.07), "between 0.05 N and"),
    ],
)
def test_values_that_the_logs_do_not_distinguish_are_given_by_their_limits(
    region: tuple[float, float], words: str
) -> None:
    h = fitted("coulomb_friction")
    flat = replace(h, fit=replace(h.fit, regions={FORCE.name: region}))
    assert f"force {words}" in claim_text(flat, flat.candidates, ModelSubject.of(CRAFT))
    (entry,) = effects(ModelSubject.of(CRAFT), flat, ())
    assert entry.parameters["force"].ci95 == region


def changed(record: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    """The record with something else at a place of it."""
    record = copy.deepcopy(record)
    node: Any = record
    *steps, last = (int(k) if k.isdigit() else k for k in path.split("/"))
    for step in steps:
        node = node[step]
    node[last] = value(node[last]) if callable(value) else value
    return record


@pytest.mark.parametrize(
    ("made", "path", "value", "words"),
    [
        ("an effect", "hidden", ["coulomb_friction"], "claimed, and not to be seen"),
        ("an effect", "candidates", [], "in the ranking"),
        ("an effect", "effects/0/parameters/force/value", 0.0615, "its interval"),
        ("an effect", "effects/0/parameters/force", {"value": 0.062, "ci95": [0.061, 0.063]}, "does not tell"),
        ("an effect", "effects/0/name", "drag", "drag is claimed and not in the sentence"),
        ("an effect", "grade", "nearest", "effect_found is nearest"),
        ("an effect", "verdict", "no_effect", "no_effect, and ['coulomb_friction'] is claimed"),
        ("an effect", "error/after/estimation/vx", 0.05, "claimed as a whole, and"),
        ("an effect", "error/after/validation/vx", 0.005, "the floor of vx on validation logs is 0.01"),
        ("an effect", "noise_floor", {"vx": 0.3}, "noise_floor is none of noise_floors"),
        ("a part", "error/after/estimation/vx", 0.08, "in the sentence, {'vx': 0.6"),
        ("a part", "grade", "claimed", "the grade is claimed"),
        ("a part", "sentence", lambda s: s.replace("The rest", "The remainder"), "does not say how much is left"),
        ("a part", "nearest", ["coulomb_friction"], "nearest.yaml contains ['coulomb_friction'], the sentence says it"),
        ("outside", "error/nearest/validation/vx", 0.06, "on sealed logs in the sentence, {'vx': 0.09"),
        ("outside", "residual/equation", "vy", "the misfit is in vy"),
        ("outside", "residual/signals", ["psi"], "it depends on psi"),
        ("outside", "residual/share", 0.6, "0.6 in the record"),
        ("outside", "sentence", lambda s: s.partition(" nearest.yaml")[0], "in the sentence None"),
        ("ambiguous", "rivals", ["coulomb_friction", "lag"], "the rival lag is not in the sentence"),
        ("ambiguous", "rivals", ["coulomb_friction"], "rivals ['coulomb_friction']"),
        ("ambiguous", "candidates/0/why", "claimed", "in the ranking"),
        ("ambiguous", "candidates/1/why", "drag: its gain may be chance", "['quadratic_drag'] is 'drag: its gain"),
        ("ambiguous", "candidates/2/why", "a rival: fits best", "['lag'] is 'a rival: fits best'"),
        ("ambiguous", "experiment", "something else", "experiment 'something else'"),
        ("too little", "rivals", ["coulomb_friction", "lag", "mass"], "none of 2 effects in the sentence, 3 in the"),
        ("only recalibrated", "noise_floors/estimation/vx", 0.02, "in the sentence, 5.00 in the record"),
        ("nothing", "hidden", ["lag"], "lag would not have shown, which the sentence does not say"),
        ("nothing", "rivals", ["lag"], "no_effect with rivals"),
        ("nothing", "error/after/estimation/vx", 0.05, "nothing is claimed, and the error after is another"),
        ("nothing", "error/nearest/validation/vx", 0.05, "nearest.yaml is the model as it was, and its error another"),
        ("something left", "residual/terms/0/gain", 90.0, "15\u00a0% in the sentence, 90.0 of 200.0 in the record"),
        ("worse on sealed logs", "error/after/validation/vx", 0.09, "the error of vx goes from 0.1 to 0.09"),
        ("below its floor", "warnings", [], "the floor of vx on validation logs is 0.01, the error 0.005; said: False"),
        ("below its floor", "floor_scatters/validation/vx", 0.5, "said: True"),
        (
            "outside",
            "error/nearest/validation/vx",
            0.005,
            "the floor of vx on validation logs is 0.01, the error 0.005",
        ),
    ],
)
def test_what_contradicts_itself_is_noticed(made: str, path: str, value: Any, words: str) -> None:
    said = contradictions(changed(MADE[made](), path, value))
    assert any(words in text for text in said), said


def test_files_that_do_not_go_with_the_grade_are_noticed(tmp_path: Path) -> None:
    for name in ("model.yaml", "plant.fmu", "refine.json"):
        (tmp_path / name).touch()
    assert contradictions(found("coulomb_friction"), tmp_path) == []
    (said,) = contradictions(nothing_missing(), tmp_path)
    assert "the files are ['model.yaml', 'plant.fmu']" in said


def test_an_effect_that_is_claimed_is_not_said_to_be_invisible() -> None:
    h, base = fitted("coulomb_friction"), Hypothesis((), fitted("mass").fit, 0.0)
    verdict = Claims("effect_found", h, grade="claimed")
    a = Attribution(base, base.fit, (h,), h, (), Support(0.0, 0.0), {}, (0.0,), hidden=("coulomb_friction", "lag"))
    assert hidden_effects(a, verdict) == ["lag"]
    assert hidden_effects(a, Claims("no_effect")) == ["coulomb_friction", "lag"]


def test_a_nearest_model_far_below_the_noise_floor_is_noticed_where_nothing_is_claimed() -> None:
    def played(size: float) -> Any:
        replay = SimpleNamespace(errors=lambda log: {"vx": np.full(9, size)})
        return {"estimation": {CRAFT.horizon: [(None, replay)]}}

    subject, floors = ModelSubject.of(CRAFT), {"estimation": Floor({"vx": 0.01}, {"vx": 0.05})}
    variants = {"after": played(0.1), "nearest": played(0.005)}
    (said,) = _floor_warnings(floors, variants, Claims("unexplained"), subject)  # type: ignore[arg-type]
    assert "estimation logs the error is below its noise floor (vx 5.00\u00a0mm/s under 10.0\u00a0mm/s)" in said
    claim = Claims("effect_found", fitted("mass"))
    assert list(_floor_warnings(floors, variants, claim, subject)) == []  # type: ignore[arg-type]
    assert list(_floor_warnings(floors, {"after": played(0.1)}, Claims("no_effect"), subject)) == []  # type: ignore[arg-type]


def test_a_floor_is_above_an_error_only_beyond_what_it_scatters() -> None:
    floor = Floor({"x": 2.0, "y": 1.1, "z": 2.0}, {"x": 0.1, "y": 0.01, "z": 0.4})
    assert floor.channels_above({"x": 1.0, "y": 1.0, "z": 1.0}) == {"x": (2.0, 1.0)}
    assert Floor({"x": 2.0}, {}).channels_above({"x": 1.0}) == {"x": (2.0, 1.0)}
    assert floor.channels_above({"x": 0.0}) == {}


def test_inputs_between_rows_are_named_only_where_something_is_unexplained() -> None:
    line, subject = "`inputs: interpolated`", ModelSubject.of(CRAFT)
    claims, words = Claims("no_effect", inputs=line), f"with {line} these logs are likelier"
    assert words not in sentence(claims, subject)
    assert words in sentence(replace(claims, name="unexplained", misfit={"equation": "", "signals": []}), subject)
