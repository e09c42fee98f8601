"""Blind studies of the laboratory half: `draw(seed)` draws a study, `write(study, folder)` writes its logs.

A study has two estimation logs and a sealed log of 40 s at 50 Hz, in closed loop with the pilot of `truth_pilot` and
the craft of `truth_craft`. Row k holds the measurement at t_k and the command that acts from t_k on.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from tests.blind.field_craft import CraftRig, craft, fly_craft, moving_start
from tests.blind.field_rig import LOGS, Array, Course, Run, coloured, csv, write_study
from tests.blind.truth_craft import STEP, VARIANCE, Craft, Flight
from tests.blind.truth_pilot import Pilot, Style
from tests.blind.truth_study import BASE, Study, draw, stream

DURATION = 40.0
DISTURBANCE = (0.004, 0.004, 0.0002)  # forward, starboard [N], yaw [N m]: standard deviations
CORRELATION_TIME = 1.0  # [s]

__all__ = ["LOGS", "VARIANCE", "Study", "answer", "craft_of", "draw", "fly", "write"]


def craft_of(study: Study) -> Craft:
    """Return the craft of a study, with wrong base parameters, effects, or an effect outside the catalogue."""
    base = {n: v["value"] for n, v in study.truth.items() if n in BASE}
    return craft(base, study.kind, {n: v for n, v in study.truth.items() if n not in BASE})


def fly(study: Study, number: int, duration: float = DURATION) -> tuple[Run, Course, Array]:
    """Return log `number` of a study: its inputs, its course, and what is logged of the sensors."""
    count = round(duration / STEP) + 1
    manoeuvre, noise, shove = (stream(study.seed, 10 + number, purpose) for purpose in range(3))
    start = moving_start(manoeuvre)
    if start:
        start |= {f"tilt_{side}": float(manoeuvre.normal(0.0, 0.03)) for side in ("right", "left")}
    made = craft_of(study)
    pilot = Pilot(manoeuvre, Style.draw(manoeuvre, study.duty_varied), count, start.get("psi", 0.0))
    pushes = np.zeros((count, 3))
    if study.disturbed:
        pushes = coloured(shove, count, DISTURBANCE, STEP, CORRELATION_TIME)
    errors = np.column_stack([sigma * noise.standard_normal(count) for sigma in CraftRig.outputs.values()])
    channels = 5 if study.position else 3
    inputs = np.arange(count) * STEP, pushes, errors
    run, course = fly_craft(Flight(made, made.rest(**start)), made, pilot, study.truth, inputs, channels)
    return run, course, (course.readings + errors)[:, :channels]


def write(study: Study, folder: Path, duration: float = DURATION) -> Path:
    """Write study.yaml and the three logs, without the answer; return the path of study.yaml."""
    logs = []
    for number in range(len(LOGS)):
        run, _, cells = fly(study, number, duration)
        names = ["time", *CraftRig.inputs, *[*CraftRig.outputs][: cells.shape[1]]]
        logs.append(csv(names, (".2f", run.times[:, None]), (".6g", run.commands), (".6g", cells)))
    return write_study(folder, "base", logs)


def answer(study: Study) -> str:
    """Return the answer as JSON, to be opened after the verdict."""
    return json.dumps(asdict(study), indent=1) + "\n"
