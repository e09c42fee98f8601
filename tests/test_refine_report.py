"""The page about a refine: what it shows is in the data, what it says is in the record, whatever the verdict."""

from __future__ import annotations

import importlib.util
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from cosim.model import Stepper
from cosim.refinement.refinement import Refinement
from cosim.refinement.report.plots import EffectComparison, compare_effects, innovations
from cosim.refinement.report.refine_page import write_refine_report
from cosim.refinement.workflow import refine
from cosim.report.charts import Charts
from cosim.residuals.residual_statistics import remaining_excess
from cosim.verbs.checks import schema_of
from plant.hovercraft import Hovercraft
from tests.logs import IMU, fly, log_of, measured, times, write_log
from tests.seen import faults
from tests.studies import proven

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
    return proven(cart_study(folder / "<b>&amp; co"), folder / "out")


@pytest.fixture(scope="module")
def craft(tmp_path_factory: pytest.TempPathFactory) -> Refinement:
    """A craft with yaw damping, its IMU alone, a single log and nothing sealed."""
    folder = tmp_path_factory.mktemp("craft")
    flight = fly(times(12.0), Hovercraft().with_values({"yaw_damping.coefficient": 0.006}))
    log_of(folder / "a.csv", measured(flight, IMU, noise=1.0))
    study = folder / "study.yaml"
    study.write_text("model: base\nlogs: {estimation: [a.csv]}\ncandidates: [yaw_damping]\n")
    return refine(study, folder / "out")


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
def test_the_page_is_whole_loads_nothing_and_hinders_nobody(cart: Refinement, tmp_path: Path) -> None:
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
    assert "<b>&" not in text  # names from files never become markup
    assert "Study &lt;b&gt;&amp;amp; co" in text
    assert "Cart &lt;of mine&gt;" in text
    assert faults(tmp_path / "report.html") == []


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
    assert found.term is not None
    assert np.corrcoef(found.term, found.estimated)[0, 1] > 0.9
    assert found.share > 0.8


def test_innovations_are_coloured_before_and_white_after(cart: Refinement) -> None:
    (row,) = innovations(cart, Charts())
    assert row["white"] == ["no", "yes"]
    assert float(row["size"][0]) > 1.5
    assert float(row["size"][1]) == pytest.approx(1.0, abs=0.1)  # 1100 samples: standard error 0.02


@pytest.mark.thorough
def test_an_imu_alone_and_no_sealed_log_are_enough(craft: Refinement, tmp_path: Path) -> None:
    text = page(craft, tmp_path)
    assert "no log sealed" in text
    assert "Sealed validation logs" not in text
    (found,) = compare_effects(craft)
    assert (found.effect, found.where, found.against.name) == ("yaw_damping", "psi_dot", "psi_dot")
    assert found.term is not None
    assert np.corrcoef(found.term, found.estimated)[0, 1] > 0.9


@pytest.mark.parametrize(
    ("name", "rivals", "says"),
    [
        ("no_effect", (), "nothing missing"),
        ("unexplained", (), "Next step: look at the figure of the remainder"),
        ("ambiguous", ("dry", "push"), "Next step: record a log with push harder."),
        ("parameter_error", (), "wrong parameter"),
    ],
)
def test_every_verdict_has_its_page(
    cart: Refinement, tmp_path: Path, name: Any, rivals: tuple[str, ...], says: str
) -> None:
    is_claimed, chances = name == "parameter_error", {frozenset({rival}): 0.5 for rival in rivals}
    claims = cart.verdict
    decision = replace(claims.decision, verdict=name, rivals=chances)
    if not is_claimed:
        decision = replace(decision, claimed={}, grade="nearest")
        claims = replace(claims, claimed=None, nearest=claims.best)
    rivalry = {"rivals": list(rivals), "experiment": "push harder" if rivals else ""}
    record = {**cart.record, **rivalry, "verdict": name, "sentence": "A sentence."}
    jsonschema.validate(record, schema_of("refine_result"))
    verdict = replace(claims, decision=decision, experiment="push harder")
    text = page(replace(cart, verdict=verdict, record=record), tmp_path)
    assert says in text
    assert all(f"<li>{rival}</li>" in text for rival in rivals)
    assert ("Left of recalibrated" in text) == is_claimed


def test_excess_left_is_that_of_the_contract() -> None:
    assert remaining_excess(5.0, 3.0, 1.0) == pytest.approx((9 - 1) / (25 - 1), rel=1e-15)
    assert remaining_excess(5.0, 5.0, 1.0) == 1.0
    assert math.isnan(remaining_excess(2.0, 1.0, 1.0))  # before is not above twice the floor
    assert math.isnan(remaining_excess(math.nan, 1.0, 1.0))
