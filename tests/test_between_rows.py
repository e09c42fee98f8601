"""Inputs held constant or interpolated between rows: evidence from the logs for the other choice."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cosim.estimation.posing import build_problem, coarsen
from cosim.estimation.problem import Problem
from cosim.fmi.building.file import load_model
from cosim.model import Stepper
from cosim.refinement.decision.bundle import between_rows
from cosim.refinement.search.fits import Hypothesis, Search
from cosim.refinement.study import read_study
from tests.logs import write_log
from tests.test_refine_conditions import MOTOR

FINE = 20  # steps of the truth in a row


def fitted(folder: Path, rig: str) -> tuple[Problem, Hypothesis]:
    """Return a study of a motor that lacks nothing, taken as held between rows, and its recalibrated model.

    Args:
        rig: Whether the rig holds a multisine between rows, or ramps it.
    """
    (folder / "motor.py").write_text(MOTOR)
    model = load_model("motor.py:Motor", folder).model
    for seed, name in enumerate("abc"):
        rng = np.random.default_rng(seed)
        time = 0.02 * np.arange(500)
        frequency, phase = rng.uniform(0.3, 8.0, 8), rng.uniform(0.0, 2.0 * np.pi, 8)
        u = 2.0 * np.sin(2.0 * np.pi * np.outer(time, frequency) + phase).sum(axis=1)
        stepper = Stepper(model)
        moment, tacho = stepper.start(), []
        for k, command in enumerate(u.tolist()):
            tacho.append(0.02 * moment.state[0])
            step = (u[min(k + 1, u.size - 1)] - command) if rig == "interpolated" else 0.0
            for part in range(FINE):
                moment = stepper.step(moment, (command + step * (part + 0.5) / FINE,), 0.02 / FINE)
        seen = np.array(tacho) + 1e-2 * rng.standard_normal(time.size)
        write_log(folder / f"{name}.csv", {"time": time, "voltage": u, "tacho": seen})
    path = folder / "study.yaml"
    logs = "logs: {estimation: [a.csv, b.csv], validation: [c.csv]}"
    path.write_text(f"model: motor.py:Motor\ninputs: held\n{logs}\n")
    study = read_study(path)
    problem = coarsen(build_problem(study.subject, study.logs, settings=study.settings))
    return problem, Search(study.subject, problem, 1, lambda stage, share: None).hypothesis((), None)


def test_an_input_that_the_rig_ramps_is_told_from_one_that_it_holds(tmp_path: Path) -> None:
    gain, warning = between_rows(*fitted(tmp_path, "interpolated"))
    assert gain > 100.0
    assert "`inputs: interpolated`" in warning
