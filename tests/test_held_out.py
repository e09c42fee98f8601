"""A claim is held against logs it was not fitted on, however unlike they are."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest

from cosim.estimation.posing import build_problem
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.logs.log import Log
from cosim.model import Stepper
from cosim.refinement.decision.posterior import held_out_gains
from cosim.refinement.search.attribution import Attributor
from plant.hovercraft import OUTPUTS, Hovercraft
from tests.logs import IMU, NOISE, POSITION, STEP, log_of, times
from tests.studies import weighed

TILT = math.radians(12)
Law = Callable[[float, Mapping[str, float]], tuple[float, float]]  # of time and readings: tilts to the right and left


def flown(path: Path, craft: Hovercraft, law: Law, seconds: float, seed: int) -> Log:
    """Fly a law that sees what is logged, at nominal duty."""
    rng, stepper = np.random.default_rng(seed), Stepper(craft)
    moment, rows, command = stepper.start(), [], (craft.duty_nominal, craft.duty_nominal, 0.0, 0.0)
    for t in times(seconds).tolist():
        outputs = stepper.output(moment.t, moment.state, command)
        true = dict(zip((q.name for q in OUTPUTS), outputs, strict=True))
        read = {name: true[name] + NOISE[name] * rng.standard_normal() for name in (*IMU, *POSITION)}
        right, left = (min(TILT, max(-TILT, tilt)) for tilt in law(t, read))
        command = (craft.duty_nominal, craft.duty_nominal, right, left)
        rows.append([t, *command, *read.values()])
        moment = stepper.step(moment, command, STEP)
    names = ("time", *(q.name for q in craft.inputs), *IMU, *POSITION)
    return log_of(path, dict(zip(names, np.array(rows).T, strict=True)))


def straight(t: float, read: Mapping[str, float]) -> tuple[float, float]:
    """Forth and back with the heading held: of the moment of inertia this tells next to nothing."""
    common, differential = (
        math.copysign(TILT, math.sin(2.0 * math.pi * t / 7.0)),
        0.3 * read["psi"] + 0.05 * read["psi_dot"],
    )
    return common - differential, common + differential


def spinning(t: float, read: Mapping[str, float]) -> tuple[float, float]:
    """Full differential tilt to and fro."""
    differential = math.copysign(TILT, math.sin(2.0 * math.pi * t / 1.3 + 0.5 * math.pi))
    return -differential, differential


@pytest.mark.thorough
def test_logs_that_are_unlike_confirm_what_each_other_shows(tmp_path: Path) -> None:
    model = Hovercraft()
    craft = model.with_values({"thrust_asymmetry.ratio": 0.02})
    flights = ((straight, 8.0), (spinning, 30.0))
    logs = [flown(tmp_path / f"{k}.csv", craft, law, seconds, k) for k, (law, seconds) in enumerate(flights)]
    problem = build_problem(ModelSubject.of(model), logs)
    trial = [c for c in ModelSubject.of(model).candidates(()) if c.name in ("thrust_asymmetry", "com_offset")]
    found = weighed(Attributor(ModelSubject.of(model), problem, trial).run())
    assert (found.decision.verdict, found.claimed) == ("effect_found", {"thrust_asymmetry"})
    # what the quiet log cannot know of inertia and process noise weighs neither for the claim nor against it
    groups = {"thrust_asymmetry": frozenset({"thrust_asymmetry"})}
    gains = held_out_gains(found.bundle.hypotheses, found.decision.dispersion, groups, len(trial))
    assert gains["thrust_asymmetry"] > 100.0
