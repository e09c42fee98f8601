"""The page about a refine: what it shows is in the data, what it says is in the record, whatever the verdict."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from markupsafe import escape

from cosim.fmi.building.file import own_model
from cosim.model import Stepper
from cosim.refinement.decision.claims import sentence
from cosim.refinement.refinement import Refinement
from cosim.refinement.report.refine_page import compare_effects, write_refine_report
from cosim.residuals.residual_statistics import remaining_excess
from cosim.verbs.checks import schema_of
from tests.logs import times, write_log
from tests.seen import faults
from tests.studies import proven

DRY, SMOOTH, MASS = 0.4, 0.02, 2.0  # [N], [m/s], [kg] of the cart
CART = """
from dataclasses import dataclass
from cosim.model import Equations, LocalEffect, Model, Quantity, parameter, size

Dry = LocalEffect.named("dry", place="cart", equation="force -F tanh(v/0.02)", force=size("N", (0, 5), 0.2, "F"),
    change=lambda e, m, pull, v: pull - e.force * m.tanh(v / 0.02))
Push = LocalEffect.named("push", place="cart", equation="force f", force=size("N", (-5, 5), 0.2, "f"),
    change=lambda e, m, pull, v: pull + e.force)

@dataclass(frozen=True, kw_only=True)
class Cart(Model):
    title = "Cart <of mine>"
    base_states = (Quantity("s", "m", "place"), Quantity("v", "m/s", "speed"))
    inputs, outputs = (Quantity("force", "N", "force"),), base_states[:1]
    catalogue, places, sensor_variance = (Dry, Push), ("cart",), {"s": 1e-6}
    forced, calibrated = ("v",), ("mass",)
    mass: float = parameter(2.0, unit="kg", bounds=(0.1, 10), doc="mass")
    drag: float = parameter(0.5, unit="N.s/m", bounds=(0, 10), doc="viscous friction")
    def equations(self, m):
        at = self.effects_at(m)
        def derivative(t, state, command):
            return state[1], at("cart", command[0] - self.drag * state[1], state[1]) / self.mass
        return Equations(derivative, lambda t, state, command: state[:1])
"""


@pytest.fixture(scope="module")
def cart(tmp_path_factory: pytest.TempPathFactory) -> Refinement:
    """Two logs of 12 s of a cart with dry friction, and a third one that is sealed."""
    folder = tmp_path_factory.mktemp("cart") / "<b>&amp; co"
    folder.mkdir()
    (folder / "cart.py").write_text(CART)
    stepper, time = Stepper(own_model("cart.py:Cart", folder).with_values({"dry.force": DRY})), times(12.0)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        waves = zip((1.2, 0.8, 0.5), (0.9, 2.3, 5.1), rng.uniform(0, 6, 3), strict=True)
        force = np.sum([a * np.sin(w * time + p) for a, w, p in waves], axis=0)
        moment, place = stepper.start(), []
        for u in force.tolist():
            place.append(moment.state[0])
            moment = stepper.step(moment, (u,), 0.02)
        noise = 1e-3 * rng.standard_normal(time.size)
        write_log(folder / f"{seed}.csv", {"time": time, "force": force, "s": np.array(place) + noise})
    (folder / "study.yaml").write_text(
        "model: cart.py:Cart\nlogs: {estimation: [0.csv, 1.csv], validation: [2.csv]}\ncandidates: [dry, push]\n"
    )
    return proven(folder / "study.yaml", folder / "out")


def page(r: Refinement, folder: Path) -> str:
    write_refine_report(folder / "report.html", r)
    return (folder / "report.html").read_text(encoding="utf-8")


@pytest.mark.thorough
def test_the_page_loads_nothing_and_hinders_nobody(cart: Refinement, tmp_path: Path) -> None:
    text = page(cart, tmp_path)
    assert re.findall(r'(?:src|href)="(?!#|data:,)[^"]', text) == []
    assert re.search(r"https?://|@import|url\(|<script[^>]* src", text) is None
    assert len(text.encode()) < 900_000
    assert re.search(r"\bnan\b|\bNone\b|\binf\b", text) is None
    assert "<b>&" not in text  # names from files never become markup
    assert "Study &lt;b&gt;&amp;amp; co" in text
    assert "Cart &lt;of mine&gt;" in text
    assert faults(tmp_path / "report.html") == []


def test_the_claimed_term_is_the_force_over_the_mass_and_the_data_show_it_to_one_who_does_not_know(
    cart: Refinement,
) -> None:
    (found,) = compare_effects(cart)
    assert (found.effect, found.where, found.against.name) == ("dry", "v", "v")
    assert found.term is not None
    assert cart.verdict.claimed is not None
    force, v = cart.verdict.claimed.fit.values["dry.force"], found.against.values
    for sign in (-1, 1):
        rows = sign * v > 8 * SMOOTH
        # the term is a mean over 20 ms; base mass recalibrated by less than 1 % acts on 0.2 m/s², and on up to 2.5 N
        assert found.term[rows] == pytest.approx(-sign * force / MASS, abs=0.02)
        # 0.2 m/s² of friction; a mean over seconds is known to σ/√(seconds/0.3), about 0.01, and turns blur as much
        assert found.estimated[rows].mean() == pytest.approx(-sign * DRY / MASS, abs=0.03)
    assert np.corrcoef(found.term, found.estimated)[0, 1] > 0.9
    assert found.share > 0.8


@pytest.mark.parametrize(
    ("name", "rivals", "tone", "verb"),
    [
        ("no_effect", (), "good", "simulate"),
        ("unexplained", (), "bad", "refine"),
        ("ambiguous", ("dry", "push"), "warn", "excite"),
        ("parameter_error", (), "good", "simulate"),
    ],
)
def test_every_verdict_has_its_word_its_tone_and_a_command_that_goes_on(
    cart: Refinement, tmp_path: Path, name: Any, rivals: tuple[str, ...], tone: str, verb: str
) -> None:
    is_claimed, chances = name == "parameter_error", {frozenset({rival}): 0.5 for rival in rivals}
    claims = cart.verdict
    decision = replace(claims.decision, verdict=name, rivals=chances)
    if not is_claimed:
        decision = replace(decision, claimed={}, grade="nearest")
        claims = replace(claims, claimed=None, nearest=claims.best)
    rivalry = {"rivals": list(rivals), "experiment": "push harder" if rivals else ""}
    verdict = replace(claims, decision=decision, experiment="push harder" if rivals else "")
    said = sentence(verdict, cart.study.subject, {}, {"s": 0.5})
    answer, more = said.split(". ", 1)
    assert len(answer.split()) <= 25
    record = {**cart.record, **rivalry, "verdict": name, "sentence": said, "untested": ["leaks"]}
    jsonschema.validate(record, schema_of("refine_result"))
    text = page(replace(cart, verdict=verdict, record=record), tmp_path)
    head, folded = text.split("<details", 1)
    assert f'<p class="verdict {tone} answer">{name.replace("_", " ")}</p>' in head
    assert f"{escape(answer)}.</p>" in head
    assert "leaks" in head
    assert f"<pre><code>cosim {verb} " in head
    assert ("push harder" in head) == (name == "ambiguous")
    assert head.count('class="bar"') >= 2  # the posterior
    assert escape(more) in folded
    assert "data-chart" not in head
    assert all(f"<li>{rival}</li>" in folded for rival in rivals)
    assert ("Remaining of recalibrated" in text) == is_claimed


def test_excess_left_is_that_of_the_contract() -> None:
    assert remaining_excess(5.0, 3.0, 1.0) == pytest.approx((9 - 1) / (25 - 1), rel=1e-15)
    assert np.isnan(remaining_excess(2.0, 1.0, 1.0))  # before is not above twice the floor
