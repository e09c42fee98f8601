"""The page about a refine: what it shows is in the data, what it says is in the record, whatever the verdict."""

from __future__ import annotations

import importlib.util
import json
import math
import re
import shlex
from dataclasses import dataclass, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from typer.testing import CliRunner

from cosim.estimation.fit import Fit
from cosim.estimation.noise_model import Noise
from cosim.estimation.posing import build_problem
from cosim.estimation.screen import ScoreTest
from cosim.loading.file import BASE, LoadedModel
from cosim.model import Stepper
from cosim.refinement.decision.claims import Claims, Nearest, judge
from cosim.refinement.decision.judgement import Refusal, decide
from cosim.refinement.decision.sentences import DISTURBED, IN_PART, sentence
from cosim.refinement.proof.refined_models import Variant
from cosim.refinement.proof.replay_check import check_claim
from cosim.refinement.record import SCHEMA, ranking, schema
from cosim.refinement.refinement import Refinement
from cosim.refinement.report.dependence import bins, explained_share
from cosim.refinement.report.effect_plots import EffectComparison, compare_effects
from cosim.refinement.report.error_tables import NOTHING_TO_EXPLAIN, error_tables, is_below_floor, second_sentence
from cosim.refinement.report.innovations import innovations
from cosim.refinement.report.plots import over_time, runs
from cosim.refinement.report.rankings import parameter_tables
from cosim.refinement.report.refine_page import context, write_refine_report
from cosim.refinement.search.attribution import Attributor
from cosim.refinement.search.fits import SearchResult
from cosim.refinement.search.hypotheses import Attribution, Hypothesis, Support
from cosim.refinement.search.unnamed import Leftover, UnnamedTerm, find_unnamed_terms
from cosim.refinement.study import LogLists, Study, StudyFile
from cosim.refinement.workflow import refine
from cosim.report.charts import Charts
from cosim.residuals.residual_statistics import remaining_excess
from cosim.residuals.windows import Replay
from cosim.subject.model_subject import ModelSubject
from cosim.verbs.cli import app
from plant.hovercraft import Hovercraft
from tests.logs import IMU, fly, log_of, measured, times, write_log
from tests.seen import faults

DRY, SMOOTH, MASS = 0.4, 0.02, 2.0  # [N], [m/s], [kg] of the cart
CART = """
from dataclasses import dataclass
from cosim.model import Effect, Equations, Model, Quantity, parameter

@dataclass(frozen=True, kw_only=True)
class Dry(Effect):
    name, equation = "dry", "force -F tanh(v/0.02)"
    force: float = parameter(0.0, unit="N", bounds=(0, 5), neutral=0.0, typical=0.2, doc="F")
    def pull(self, m, v):
        return -self.force * m.tanh(v / 0.02)

@dataclass(frozen=True, kw_only=True)
class Push(Effect):
    name, equation = "push", "force f"
    force: float = parameter(0.0, unit="N", bounds=(-5, 5), neutral=0.0, typical=0.2, doc="f")
    def pull(self, m, v):
        return self.force

@dataclass(frozen=True, kw_only=True)
class Cart(Model):
    title = "Cart <of mine>"
    base_states = (Quantity("s", "m", "place"), Quantity("v", "m/s", "speed"))
    inputs, outputs = (Quantity("force", "N", "force"),), base_states[:1]
    catalogue, sensor_variance = (Dry, Push), {"s": 1e-6}
    forced, calibrated = ("v",), ("mass",)
    mass: float = parameter(2.0, unit="kg", bounds=(0.1, 10), doc="mass")
    drag: float = parameter(0.5, unit="N.s/m", bounds=(0, 10), doc="viscous friction")
    def equations(self, m):
        def derivative(t, state, command):
            pulls = sum(e.pull(m, state[1]) for e in self.awake)
            return state[1], (command[0] - self.drag * state[1] + pulls) / self.mass
        return Equations(derivative, lambda t, state, command: state[:1])
"""


def cart_study(folder: Path, sealed: bool = True) -> Path:
    """Two logs of 12 s of a cart with dry friction, and a third one that is sealed."""
    folder.mkdir(parents=True)
    (folder / "cart.py").write_text(CART)
    spec = importlib.util.spec_from_file_location("cart_of_a_test", folder / "cart.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    time, names = times(12.0), ["e1.csv", "e2.csv", "v1.csv"]
    for seed, name in enumerate(names):
        rng = np.random.default_rng(seed)
        waves = zip((1.2, 0.8, 0.5), (0.9, 2.3, 5.1), rng.uniform(0, 6, 3), strict=True)
        force = np.sum([a * np.sin(w * time + p) for a, w, p in waves], axis=0)
        stepper = Stepper(module.Cart().with_values({"dry.force": DRY}))
        moment, place = stepper.start(), []
        for u in force.tolist():
            place.append(moment.state[0])
            moment = stepper.step(moment, (u,), 0.02)
        noise = 1e-3 * rng.standard_normal(time.size)
        write_log(folder / name, {"time": time, "force": force, "s": np.array(place) + noise})
    validation = "  validation: [v1.csv]\n" if sealed else ""
    path = folder / "study.yaml"
    path.write_text(
        f"model: cart.py:Cart\nlogs:\n  estimation: [e1.csv, e2.csv]\n{validation}candidates: [dry, push]\n"
    )
    return path


@pytest.fixture(scope="module")
def cart(tmp_path_factory: pytest.TempPathFactory) -> Refinement:
    folder = tmp_path_factory.mktemp("cart")
    return refine(cart_study(folder / "<b>&amp; co"), folder / "out")


@pytest.fixture(scope="module")
def craft(tmp_path_factory: pytest.TempPathFactory) -> Refinement:
    """A craft with yaw damping, its IMU alone, nothing sealed; the replays are the truth's."""
    folder, model = tmp_path_factory.mktemp("craft"), Hovercraft()
    flight = fly(times(12.0), model.with_values({"yaw_damping.coefficient": 0.006}))
    log = log_of(folder / "a.csv", measured(flight, IMU, noise=1.0))
    subject = ModelSubject(LoadedModel(model, BASE))
    problem = build_problem(subject, [log])
    trial = [c for c in subject.candidates(()) if c.name == "yaw_damping"]
    found = decide(Attributor(subject, problem, trial).run())
    assert found.best.names == ("yaw_damping",)
    fit = found.best.fit
    verdict = Claims("effect_found", found.best, misfit={"process_noise": {}})
    variants = {
        "before": Variant(subject, problem.values, found.base.fit.noise),
        "after": Variant(subject.refined({"yaw_damping.coefficient": 0.006}), fit.values, fit.noise),
    }
    variants["recalibrated"] = variants["before"]
    starts: dict[int, dict[str, Any]] = {k: {} for k in range(100, 600, 100)}
    seen = {n: np.where(np.arange(log.rows) > 100, flight.outputs[n], np.nan) for n in IMU}
    replay = Replay(log.time, 2.0, starts, seen, dict(log.units))
    evidence = {name: {"estimation": [(log, replay)]} for name in variants}
    study = Study(folder / "study.yaml", StudyFile(logs=LogLists(estimation=["a.csv"])), subject, (log,))
    return Refinement(study, found, verdict, _record(found), folder, problem, variants, evidence)


def _record(found: Attribution) -> dict[str, Any]:
    """What the page reads of refine.json."""
    rows = [
        {"names": list(h.names), "score_gain": found.base.score - h.score, "why": "claimed", "fitted": True,
         "parameters": {n: h.fit.values[n] for c in h.candidates for n in c.parameters}}
        for h in found.tried
    ]  # fmt: skip
    sizes = {"psi": 0.1, "psi_dot": 0.2, "ax": math.nan}
    error = {name: {"estimation": sizes} for name in ("before", "recalibrated", "after")}
    return {
        "sentence": "It lacks yaw_damping.", "seconds": 1.0, "warnings": [], "held_out_gain": 0.0, "candidates": rows,
        "error": error, "horizons": {"0.5 s": error, "free run": error},
        "noise_floors": {"estimation": {"psi": 0.01}},
    }  # fmt: skip


def page(r: Refinement, folder: Path) -> str:
    write_refine_report(folder / "report.html", r)
    return (folder / "report.html").read_text(encoding="utf-8")


class Tags(HTMLParser):
    """Collects elements that are not closed in order, and what would load something."""

    VOID = ("meta", "link", "path", "br")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loads: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.loads += [
            f"{tag} {n}={v}" for n, v in attrs if n in ("src", "href") and v and v[0] != "#" and v != "data:,"
        ]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in self.VOID:
            assert self.open.pop() == tag


@pytest.mark.thorough
def test_the_page_is_whole_and_loads_nothing(cart: Refinement, tmp_path: Path) -> None:
    text = page(cart, tmp_path)
    tags = Tags()
    tags.feed(text)
    assert (tags.open, tags.loads) == ([], [])
    assert re.search(r"https?://|@import|url\(|<script[^>]* src", text) is None
    assert len(text.encode()) < 900_000
    assert re.search(r"\bnan\b|\bNone\b|\binf\b", text) is None
    targets = re.findall(r'href="#(\w+)"', text)
    assert targets
    assert all(f'id="{t}"' in text for t in targets)


@pytest.mark.thorough
def test_names_from_files_never_become_markup(cart: Refinement, tmp_path: Path) -> None:
    text = page(cart, tmp_path)
    assert "<b>&" not in text
    assert "Study &lt;b&gt;&amp;amp; co" in text
    assert "Cart &lt;of mine&gt;" in text


def test_every_chart_of_the_page_can_be_looked_into(cart: Refinement, tmp_path: Path) -> None:
    text = page(cart, tmp_path).partition("<script")[0]
    assert text.count("<figure") == len(set(re.findall(r'data-chart="(\d+)"', text))) > 5


@pytest.mark.thorough
def test_nothing_serious_hinders_who_uses_keys_or_sees_little_in_the_page_of_a_refine(
    cart: Refinement, tmp_path: Path
) -> None:
    page(cart, tmp_path)
    assert faults(tmp_path / "report.html") == []


def test_what_is_to_be_typed_stands_as_code(cart: Refinement, tmp_path: Path) -> None:
    record = {**cart.record, "sentence": "These logs <cannot> tell; `cosim excite` designs it."}
    text = page(replace(cart, record=record), tmp_path)
    assert "These logs &lt;cannot&gt; tell; <code>cosim excite</code> designs it." in text


def test_the_commands_to_repeat_a_study_name_files_from_the_current_folder(
    cart: Refinement, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def commands() -> list[str]:
        values = context(cart)
        rows = [row.value for row in values["provenance"] if row.label not in {"Inputs", "Made by"}]
        return [*shlex.split(values["use"]), *shlex.split(values["repeat"]), *rows]

    monkeypatch.chdir(tmp_path)
    assert str(cart.study.path) in commands()  # nothing of the study lies below
    monkeypatch.chdir(cart.folder.parent)
    words = commands()
    study, out = words[words.index("refine") + 1], words[words.index("--out") + 1]
    assert (study, out) == (f"{cart.study.name}/study.yaml", "out")
    assert not [word for word in words if str(cart.folder.parent) in word]
    assert Path(study).is_file()
    assert Path(words[words.index("--set") + 1].partition("=")[2]).is_file()


def test_the_second_sentence_says_what_the_record_says_of_sealed_runs(cart: Refinement) -> None:
    error, floor = cart.record["error"], cart.record["noise_floors"]["validation"]["s"]
    shown_sizes = re.findall(r"([\d.]+)\u00a0mm", second_sentence(cart))
    expected = [error["before"]["validation"]["s"], error["after"]["validation"]["s"], floor]
    # three digits are printed: 0.5 % at most off
    assert [float(x) for x in shown_sizes] == pytest.approx([1000 * v for v in expected], rel=5e-3)
    assert "On sealed logs" in second_sentence(cart)
    without = replace(cart, record=cart.record | {"noise_floors": {"validation": {}}})
    assert second_sentence(without).endswith("mm.")
    assert "noise floor" not in second_sentence(without)


@pytest.mark.thorough
def test_the_command_tells_the_verdict_and_what_became_of_the_error(cart: Refinement, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = CliRunner().invoke(app, ["refine", str(cart.study.path), "--out", str(out), "--no-report"])
    assert result.exit_code == 0, result.output
    lines = result.output.strip().splitlines()
    at = lines.index("verdict: effect_found")
    assert lines[at + 1] == f"{cart.record['sentence']} {second_sentence(cart)}"
    shown = error_tables(cart)[-1].rows[0]
    assert [line.split("  ")[0] for line in lines[at + 4 : at + 6]] == ["channel", "s"]
    assert all(text in lines[at + 5] for text in (shown.before, shown.after, shown.floor))
    assert lines[-2:] == [f"model:   {out / 'model.yaml'}", f"FMU:     {out / 'plant.fmu'}"]


def dry_friction(r: Refinement) -> EffectComparison:
    (found,) = compare_effects(r)
    assert (found.effect, found.where, found.against.name) == ("dry", "v", "v")
    return found


def test_the_claimed_term_is_the_force_of_the_effect_over_the_mass(cart: Refinement) -> None:
    found = dry_friction(cart)
    assert found.term is not None
    assert cart.verdict.claimed is not None
    force = cart.verdict.claimed.fit.values["dry.force"]
    moving = np.abs(found.against.values) > 8 * SMOOTH
    expected = -force / MASS * np.sign(found.against.values[moving])
    # the term is a mean over 20 ms; base mass recalibrated by less than 1 % acts on 0.2 m/s², forces of up to 2.5 N too
    assert found.term[moving] == pytest.approx(expected, abs=0.02)


def test_the_data_show_dry_friction_to_one_who_does_not_know_of_it(cart: Refinement) -> None:
    found = dry_friction(cart)
    for sign in (-1, 1):
        rows = sign * found.against.values > 8 * SMOOTH
        # 0.2 m/s² of friction; a mean over seconds is known to σ/√(seconds/0.3), about 0.01, and turns blur as much
        assert found.estimated[rows].mean() == pytest.approx(-sign * DRY / MASS, abs=0.03)
    assert found.correlation > 0.9
    assert found.share > 0.8


def test_innovations_are_coloured_before_and_white_after(cart: Refinement) -> None:
    (row,) = innovations(cart, Charts())
    assert row.white == ("no", "yes")
    assert float(row.size[0]) > 1.5
    assert float(row.size[1]) == pytest.approx(1.0, abs=0.1)  # 1100 samples: standard error 0.02


@pytest.mark.thorough
def test_an_imu_alone_and_no_sealed_log_are_enough(craft: Refinement, tmp_path: Path) -> None:
    text = page(craft, tmp_path)
    assert "no log sealed" in text
    assert "Sealed validation logs" not in text
    assert "no log was kept for a test at the end" in second_sentence(craft)
    (found,) = compare_effects(craft)
    assert (found.effect, found.where, found.against.name) == ("yaw_damping", "psi_dot", "psi_dot")
    assert found.correlation > 0.9


@pytest.mark.thorough
def test_each_restart_of_the_model_breaks_its_curve(craft: Refinement) -> None:
    charts = Charts()
    (run,) = runs(craft, charts)
    for pair in (*run.channels, *run.quiet):
        refined = next(t for t in pair.plots[0].spec["traces"] if t["label"] == "refined")
        assert refined["anew"]
        assert pair.plots[0].spec["band"]["label"] == "every other replay"
    assert len(json.loads(charts.data())["groups"][0]["breaks"]) == 5


NONE = ("", {"process_noise": {"v": {"before": 1e-3, "after": 1e-3, "inflated": True}}})


@pytest.mark.parametrize(
    ("name", "rivals", "says"),
    [
        ("no_effect", (), "nothing missing"),
        pytest.param("unexplained", (), "unexplained", marks=pytest.mark.thorough),
        ("unexplained", ("dry",), "Best candidates, not confirmed:<ul><li>dry</li>"),
        ("ambiguous", ("dry", "push"), "Next step: record a log with push harder."),
        pytest.param("ambiguous", ("dry",), "the model is left as it was", marks=pytest.mark.thorough),
        ("parameter_error", (), "wrong parameter"),
    ],
)
def test_every_verdict_has_its_page(
    cart: Refinement, tmp_path: Path, name: Any, rivals: tuple[str, ...], says: str
) -> None:
    claimed = cart.verdict.claimed if name == "parameter_error" or len(rivals) > 1 else None
    verdict = Claims(name, claimed, rivals, "push harder", NONE[1])
    rivalry = {"rivals": list(rivals) if name == "ambiguous" else [], "experiment": "push harder"}
    record = {**cart.record, **rivalry, "verdict": name, "sentence": "A sentence."}
    jsonschema.validate(record, json.loads(SCHEMA.read_text()))
    text = page(replace(cart, verdict=verdict, record=record), tmp_path)
    assert says in text
    assert ("Left of recalibrated" in text) == (claimed is not None)
    assert ('id="term"' in text) == (name == "unexplained" or claimed is not None)


def unclaimed(r: Refinement) -> Refinement:
    """The study as if its claim were the nearest model only."""
    error = {**r.record["error"], "after": r.record["error"]["before"], "nearest": r.record["error"]["after"]}
    horizons = dict.fromkeys(r.record["horizons"], error)
    evidence = {**r.evidence, "after": r.evidence["before"], "nearest": r.evidence["after"]}
    verdict = Claims("unexplained", misfit=NONE[1], nearest=Nearest(r.attribution.best))
    record = {**r.record, "error": error, "horizons": horizons, "verdict": "unexplained", "nearest": ["dry"]}
    return replace(r, verdict=verdict, record=record, evidence=evidence)


def test_a_page_without_a_claim_leads_to_the_nearest_model_and_draws_it(cart: Refinement, tmp_path: Path) -> None:
    for name in ("model.yaml", "plant.fmu", "nearest.yaml", "nearest.fmu"):
        (tmp_path / name).touch()
    values = context(r := replace(unclaimed(cart), folder=tmp_path))
    assert values["use_lead"].startswith("Nothing was refined; the model that predicts best is nearest.fmu.")
    assert values["use"].endswith("/nearest.fmu")
    labels = [t["label"] for t in values["lead"]["plots"][0].spec["traces"]]
    assert labels == ["measured", "model", "nearest"]
    labels = [row.label for row in values["provenance"]]
    assert labels[-5:-1] == ["Model, unchanged", "FMU, unchanged", "Nearest model", "Nearest FMU"]
    assert any(badge.text.endswith(" s elapsed") for badge in values["badges"])
    tables = {table.title: table for table in parameter_tables(r)}
    assert [row.name for row in tables["Added parameters of the nearest model"].rows] == ["dry.force"]
    assert "only if its whole interval lies outside the tolerance" in tables["Base parameters, recalibrated"].note
    neither = context(replace(r, verdict=replace(r.verdict, nearest=Nearest(None))))
    assert neither["use_lead"].startswith("Nothing was refined; the delivered model is the model as it was.")
    assert neither["use"].endswith("/plant.fmu")
    assert [t["label"] for t in neither["lead"]["plots"][0].spec["traces"]] == ["measured", "model"]
    assert context(cart)["use_lead"].startswith("To use the refined model")


def test_a_noise_floor_with_an_unknown_input_is_not_called_sensor_noise(cart: Refinement) -> None:
    def floor_of(r: Refinement) -> str:
        return next(row.value for row in context(r)["error_words"] if row.label == "Noise floor")

    assert "(the error by sensor noise alone)" in second_sentence(cart)
    assert floor_of(cart).startswith("The error that sensor noise alone would cause.")
    r = unclaimed(cart)
    base = replace(r, verdict=replace(r.verdict, nearest=Nearest(cart.attribution.base)))  # lacks dry friction
    said = second_sentence(base)
    rest = "the estimated unknown input, which may include what is missing,"
    two = re.search(rf"; sensor noise alone makes ([\d.]+)\u00a0mm, {rest} ([\d.]+)\u00a0mm\.$", said)
    assert two is not None, said
    part = "validation" if said.startswith("On sealed logs") else "estimation"
    assert 0.95 <= float(two[1]) <= 1.1  # 1 mm in the logs
    floor = 1e3 * base.record["noise_floors"][part]["s"]
    assert math.hypot(float(two[1]), float(two[2])) == pytest.approx(floor, rel=0.02)
    assert "may include what is missing" in floor_of(base)
    assert not is_below_floor(base)
    assert "lie below it" not in floor_of(base)
    high = {part: {"s": 2.0 * of["s"]} for part, of in base.record["error"]["nearest"].items()}
    below = replace(base, record={**base.record, "noise_floors": high})
    assert "below the noise floor" not in second_sentence(below)
    excesses = {row.excess for table in error_tables(below) for row in table.rows}
    assert NOTHING_TO_EXPLAIN not in excesses  # a floor with what is missing makes no error small
    assert floor_of(below).endswith("The floor is an estimate; some errors lie below it.")


def test_what_is_left_is_drawn_with_the_term_that_explains_it(cart: Refinement) -> None:
    terms = [{"equation": "v", "signal": n, "gain": 99.0, "coefficient": c} for n, c in (("v", -0.5), ("1", 5.0))]
    residual = {**NONE[1], "equation": "v", "signals": ["v", "1"], "share": 0.6, "terms": terms}
    base = replace(cart.attribution, best=cart.attribution.base)
    r = replace(cart, attribution=base, verdict=Claims("unexplained", misfit=residual))
    (found,) = compare_effects(r)
    assert (found.against.name, found.share) == ("v", 0.6)
    assert found.term is not None
    speed, lacking = found.against.values, found.estimated
    # dry friction as a drag: the slope is that of the least squares
    assert np.polyfit(speed, found.term, 1) == pytest.approx(
        [lacking @ speed / (speed @ speed), 0.0], rel=1e-9, abs=1e-9
    )
    assert "the term in v explains 60\u00a0%" in context(r)["terms"][0]["sentence"]


def test_a_term_is_compared_by_means_where_much_changes_from_row_to_row(cart: Refinement) -> None:
    (effect,) = compare_effects(cart)
    assert effect.term is not None
    jumping = 5.0 * np.std(effect.term) * (-1.0) ** np.arange(effect.term.size)
    effect = replace(effect, estimated=effect.term + jumping)
    assert effect.share < 0.1
    assert effect.share_of_means > 0.9
    effect = replace(effect, horizon=20 * effect.step)
    assert "data, mean over" in over_time(effect, Charts()).spec["traces"][0]["label"]
    assert over_time(replace(effect, horizon=0.0), Charts()).spec["traces"][0]["label"] == "data"


CRAFT = ModelSubject.of(Hovercraft())


def words(claims: Claims, r: Refinement) -> str:
    return sentence(claims, r.study.subject)


@dataclass(frozen=True)
class Judged:
    """The cart's attribution, to be judged with another outcome."""

    r: Refinement

    def __call__(self, *unnamed: UnnamedTerm, moves: float = 0.0, **changed: Any) -> Claims:
        a = replace(self.r.attribution, **changed)
        left = Leftover(unnamed, a.best.fit if unnamed else None, sum(u.gain for u in unnamed), 8.0)
        return judge(a, left, self.r.study.subject, ["v"], {"v": moves} if moves else {}, still=False)

    def single(self, name: str) -> Hypothesis:
        """One candidate alone, as the claim was fitted: whether it was worth a fit of its own does not matter here."""
        subject, a = self.r.study.subject, self.r.attribution
        candidate = next(c for c in subject.candidates(()) if c.name == name)
        return replace(a.best, candidates=(candidate,))


def test_what_rivals_have_in_common_is_said_to_be_missing(cart: Refinement) -> None:
    judged = Judged(cart)
    dry, (push,) = judged.single("dry"), judged.single("push").candidates
    best, rival = (replace(dry, candidates=(*dry.candidates, c)) for c in (push, replace(push, name="shove")))
    verdict = judged(best=best, rivals=(rival,))
    assert (verdict.name, verdict.rivals) == ("ambiguous", ("dry + push", "dry + shove"))
    assert words(verdict, cart).startswith("The model lacks dry (force = 0.")
    assert ". Beside this, these logs cannot tell push from shove. An experiment that may decide: " in words(
        verdict, cart
    )
    alone = judged(best=dry, rivals=(judged.single("push"),))
    assert words(alone, cart).startswith("These logs cannot tell dry from push. ")


def test_what_gains_too_little_to_be_told_from_chance_is_named_beside_the_claim(cart: Refinement) -> None:
    judged = Judged(cart)
    dry, (push,) = judged.single("dry"), judged.single("push").candidates
    fuller = replace(dry, candidates=(*dry.candidates, push), score=dry.score - 1.0)
    claimed = judged(best=dry, rivals=(), fuller=fuller)
    assert (claimed.name, claimed.claimed) == ("effect_found", dry)
    assert words(claimed, cart).endswith(" Perhaps also push; that gain may be chance.")
    base = cart.attribution.base
    none = judged(best=base, rivals=(), noise_gain=(0.0,), fuller=dry)
    assert (
        none.name,
        words(none, cart).endswith("noise. Perhaps also dry; that gain may be chance."),
    ) == (
        "no_effect",
        True,
    )
    assert "Perhaps" not in words(judged(best=dry, rivals=(), fuller=None), cart)
    # where nothing is certain it is one of those that the logs leave open
    shove = replace(push, name="shove")
    other = replace(dry, candidates=(shove,))
    open_ = judged(best=dry, rivals=(other,), fuller=fuller)
    assert open_.rivals == ("dry", "shove", "dry + push")
    assert words(open_, cart).startswith("These logs cannot decide between dry, shove and dry + push. ")
    refused = Refusal(fuller.names, "its gain may be chance: 3.1, 1.2 times its scatter").against("push", fuller)
    lost = {("shove",): "explains as well as dry", fuller.names: refused, (): "no gain"}
    tried = replace(cart.attribution, best=dry, tried=(fuller, dry, other, base), reasons=lost)
    why = {" + ".join(row.names): row.why for row in ranking(tried, open_)}
    assert why.pop("") == "no gain"
    assert all(text.startswith("a rival: ") for text in why.values())
    assert why.keys() == {*open_.rivals}
    otherwise = {" + ".join(row.names): row.why for row in ranking(tried, claimed)}
    assert otherwise == {"dry": "claimed", "shove": lost["shove",], "dry + push": refused, "": "no gain"}


def test_the_deficient_equation_is_that_whose_noise_is_worth_most_not_that_of_the_largest_number() -> None:
    noise = Noise(np.log([4.0, 2.0, 1.0]), math.log(0.15), np.zeros(3), np.full(3, -np.inf))
    fit = Fit({}, noise, (), (0.0,), 0.0, np.zeros((0, 0)), 1, True)
    base = Hypothesis((), fit, 0.0)
    a = Attribution(base, base.fit, (), base, (), Support(0.0, 0.0), {}, (1.0, 50.0, 90.0))

    def judged(**moves: float) -> Claims:
        forced = ["psi_dot", "vx", "vy"]
        return judge(a, Leftover((), None, 0.0, 8.0), ModelSubject.of(Hovercraft()), forced, moves, still=False)

    small = judged(vx=0.018, vy=0.01)
    assert (small.name, small.misfit["equation"]) == ("no_effect", "vy")
    assert [q["inflated"] for q in small.misfit["process_noise"].values()] == [False, True, True]
    sizes = "Its size: 2\u00a0% of the derivative of vx and 1\u00a0% of the derivative of vy."
    assert sentence(small, CRAFT) == f"{DISTURBED} {sizes}"
    # where a disturbance is no small one, it is the equation that it moves most
    large = judged(vx=0.3, vy=0.03)
    assert (large.name, large.claimed, large.misfit["equation"]) == ("unexplained", None, "vx")
    assert sentence(large, CRAFT) == "The remaining error shows no stable pattern."


def test_a_claim_that_leaves_much_of_the_error_says_so_and_one_that_leaves_most_is_withdrawn(cart: Refinement) -> None:
    verdict = Judged(cart)(rivals=())
    before, same = {"x": 11.0, "v": 5.0, "quiet": 1.5}, {"x": 11.0, "v": 5.0, "quiet": 1.5}
    floor = dict.fromkeys(before, 1.0)

    def held(
        after: dict[str, float], before: dict[str, float] = before, recalibrated: dict[str, float] = same
    ) -> Claims:
        errors = {"before": before, "recalibrated": recalibrated, "after": after}
        return check_claim(verdict, errors, floor, alternative="recalibrated")

    assert held({"x": 1.2, "v": 1.5, "quiet": 1.5}) is verdict  # 5 % of the excess of v stays
    part = held({"x": 1.2, "v": 2.1, "quiet": 1.5})  # 3.41 of 24
    assert (part.name, part.grade, part.claimed) == (verdict.name, "part", verdict.claimed)
    assert words(part, cart).startswith(words(verdict, cart))
    assert f"{IN_PART}: replays keep 14\u00a0% of the excess error of v. The rest has no place" in words(part, cart)
    assert held({"x": 1.2, "v": 5.0, "quiet": 1.5}).grade == "part"  # one channel is mended
    withdrawn = held({"x": 9.0, "v": 5.0, "quiet": 1.0})
    assert withdrawn.grade == "nearest"
    assert (withdrawn.name, withdrawn.claimed, withdrawn.rivals) == ("unexplained", None, cart.attribution.best.names)
    assert words(withdrawn, cart).endswith("With it, replays keep 67\u00a0% of the excess error.")  # 80 of 120
    # where no channel was far off before, there is no excess to tell of
    near = {**before, "x": 1.9, "v": 1.9}
    assert held({"x": 1.9, "v": 1.9, "quiet": 1.0}, near) is verdict
    # but an effect has to do better than the base parameters do without it
    worse = held({"x": 1.9, "v": 1.9, "quiet": 1.5}, near, {"x": 1.8, "v": 1.7, "quiet": 1.5})
    assert worse.name == "unexplained"
    assert words(worse, cart).endswith("nearer on no channel than those of the model without it.")


def test_a_sentence_says_of_a_term_without_a_name_how_much_it_is(cart: Refinement) -> None:
    judged, base = Judged(cart), cart.attribution.base
    terms = (UnnamedTerm("v", "1", 40.0, 0.1, 41.0, 0.79), UnnamedTerm("v", "time", 30.0, 0.1, 30.0))
    verdict = judged(*terms, best=base, rivals=(), noise_gain=(50.0,))
    assert verdict.name == "unexplained"
    assert "acts on v; it is constant. This dependence explains 79\u00a0% of what is missing." in words(verdict, cart)
    assert (verdict.misfit["signals"], verdict.misfit["share"]) == (["1", "time"], 0.79)
    nothing = judged(UnnamedTerm("v", "1", 40.0, 0.1, 41.0, 0.0), best=base, rivals=(), noise_gain=(50.0,))
    assert words(nothing, cart).endswith("acts on v; it is constant.")
    gained = base.score - cart.attribution.best.score
    # a claim that halves the held-out error stays, whatever a term without a name would add to it
    assert cart.attribution.halves_error
    assert judged(UnnamedTerm("v", "|v|", 0.35 * gained, 0.1, 0.35 * gained), rivals=()).claimed
    disputed = judged(UnnamedTerm("v", "|v|", 0.35 * gained, 0.1, 0.35 * gained), rivals=(), error_ratios=(0.7, 0.8))
    assert (disputed.name, disputed.claimed, disputed.rivals) == ("unexplained", None, cart.attribution.best.names)
    left = judged(UnnamedTerm("v", "|v|", 0.25 * gained, 0.1, 0.25 * gained), rivals=())
    assert left.claimed is cart.attribution.best
    assert (
        "in the equation of v that depends on |v|. A term without a name would add 25\u00a0% to the claim's"
        in words(left, cart)
    )


def test_a_base_model_in_a_local_optimum_is_fitted_again_from_the_best_hypothesis(
    cart: Refinement, monkeypatch: pytest.MonkeyPatch
) -> None:
    subject = cart.study.subject
    attributor = Attributor(subject, build_problem(subject, cart.study.logs), subject.candidates(()))
    base = attributor.search.hypothesis((), None)
    push = next(c for c in subject.candidates(()) if c.name == "push")
    best = replace(base, candidates=(push,))  # with a candidate that does nothing
    assert attributor._better_base(base, best) is base
    stuck = replace(base, fit=replace(base.fit, nll_by_log=tuple(nll + 100.0 for nll in base.fit.nll_by_log)))
    assert attributor._better_base(stuck, best).fit.objective == pytest.approx(base.fit.objective, abs=1.0)
    begun: list[Hypothesis] = []

    def search_from(start: Hypothesis) -> SearchResult:
        """Begin in the local optimum; only then is a candidate the best."""
        begun.append(start)
        attributor.search.tried = {(): start if begun[1:] else stuck}
        return SearchResult(attributor.search, start if begun[1:] else best, (), ())

    monkeypatch.setattr(attributor, "_search_from", search_from)
    assert attributor.run().best is begun[1]
    assert begun[1].fit.objective == pytest.approx(base.fit.objective, abs=1.0)


@pytest.mark.thorough
def test_of_terms_that_the_logs_do_not_tell_apart_the_simplest_stands_for_all(cart: Refinement) -> None:
    subject, logs, base = cart.study.subject, cart.study.logs, cart.attribution.base.fit
    problem = replace(build_problem(subject, logs, unnamed=True), sensing=base.noise)
    left = find_unnamed_terms(problem, base, 0.5 * math.log(problem.samples))
    found = left.terms
    assert left.fit is not None
    assert all(left.cost < u.gain for u in found)
    assert left.gain > left.cost
    assert found[0].equation == "v"
    assert found[0].share is not None
    assert 0.3 < found[0].share < 1.0  # a drag, or what else a term of one signal makes of dry friction
    test = ScoreTest(problem, base)
    rows = [test.row({f"unnamed.v.{u.signal}": 0.01}) for u in found]
    directions = np.array([row / np.linalg.norm(row) for row in rows])
    assert np.abs(np.tril(directions @ directions.T, -1)).max() <= 0.95
    assert [u.most for u in found] == sorted((u.most for u in found), reverse=True)


def test_every_hypothesis_has_its_reason_and_only_what_is_claimed_is_claimed(cart: Refinement) -> None:
    rows = ranking(cart.attribution, cart.verdict)
    assert all(row.why for row in rows)
    assert [tuple(row.names) for row in rows if row.why == "claimed"] == [cart.attribution.best.names]
    unclaimed = ranking(cart.attribution, Claims("unexplained", rivals=("dry",)))
    assert [row.why for row in unclaimed if tuple(row.names) == ("dry",)] == ["nearest, but disputed"]
    assert json.loads(SCHEMA.read_text(encoding="utf-8")) == schema()


def test_excess_left_is_that_of_the_contract() -> None:
    assert remaining_excess(5.0, 3.0, 1.0) == pytest.approx((9 - 1) / (25 - 1), rel=1e-15)
    assert remaining_excess(5.0, 5.0, 1.0) == 1.0
    assert math.isnan(remaining_excess(2.0, 1.0, 1.0))  # before is not above twice the floor
    assert math.isnan(remaining_excess(math.nan, 1.0, 1.0))


def test_bins_hold_every_row_once_and_none_too_few() -> None:
    x = np.concatenate((np.random.default_rng(1).standard_normal(500), [40.0]))
    found = bins(x, 20, 10)
    assert sorted(np.concatenate(found).tolist()) == list(range(501))
    assert min(map(len, found)) >= 10
    assert [k.tolist() for k in bins(np.ones(3), 4, 2)] == [[0, 1, 2]]
    assert explained_share(x**2, x) > 0.9
    assert explained_share(x, np.ones(501)) == 0.0


@pytest.mark.thorough
def test_the_same_refine_gives_the_same_page(cart: Refinement, tmp_path: Path) -> None:
    assert page(cart, tmp_path) == page(cart, tmp_path)
    assert context(cart)["windowed"]
