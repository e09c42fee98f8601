"""Files of a study of the field half: study.yaml, the plant's model file, two estimation logs and a sealed log.

The answer contains `error_true`, the root mean square error of the true model on the sealed log by channel.
"""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from tests.blind.field_craft import CraftRig, craft, replay_craft
from tests.blind.field_rig import LOGS, Array, Course, Run, csv, write_study
from tests.blind.field_study import Study, course, noise, rows_to_keep, stream, undisturbed

PLANTS = Path(__file__).with_name("plants")
SKIPPED = 2.0  # [s] of rows of 50 ms and faster that are not judged at the start of a log; longer where rows are slower
SEALED = LOGS.index("v1")


def recorded(study: Study, number: int) -> tuple[Run, Course, Array]:
    """Return log `number`: its inputs, its course, and the recorded cells, NaN if missing."""
    run, result = course(study, number)
    spoiling = stream(study.seed, 10 + number, 5)
    cells = study.recorder.spoil(spoiling, study.rig, result.readings, noise(study, number), study.stamp_error)
    return run, result, np.where(rows_to_keep(study, number), cells, np.nan)


def write(study: Study, folder: Path) -> Path:
    """Write study.yaml, the model file and the logs, without the answer; return the path of study.yaml."""
    if study.plant == "craft":  # the tolerances of the others are in their model files
        return write_study(
            folder, "base", logs_of(study), {name: share for name, (_, share) in study.rig.sheet.items()}
        )
    path = write_study(folder, f"{study.plant}.py:{study.rig.model}", logs_of(study))
    shutil.copyfile(PLANTS / f"{study.plant}.py", folder / f"{study.plant}.py")
    return path


def logs_of(study: Study) -> list[str]:
    """Return the logs as CSV without rows that are lost as a whole."""
    texts = []
    for number in range(len(LOGS)):
        run, _, cells = recorded(study, number)
        kept = ~np.isnan(cells).all(axis=1) | (not study.recorder.whole_rows)
        columns = (".6f", run.times[kept, None]), (".6g", run.commands[kept]), (".7g", cells[kept])
        texts.append(csv(["time", *study.rig.inputs, *study.rig.outputs], *columns))
    return texts


def true_error(study: Study) -> dict[str, float]:
    """Return the root mean square of recorded − true model on the sealed log, by channel.

    The true model starts at the true state once per horizon, with the true sensor errors and without disturbance. Cells
    are those of the log, outliers included.
    """
    rig = study.rig
    run, result, cells = recorded(study, SEALED)
    if isinstance(rig, CraftRig):
        predicted = replay_craft(craft(study.base, study.truth), study.truth, run, result)
    else:
        resets = {k: result.states[k] for k in range(0, run.times.size, round(rig.horizon / rig.step))}
        predicted = rig.course(rig.numbers(study.base, study.truth), undisturbed(run), resets).readings
    skipped = SKIPPED * max(1.0, math.ceil(rig.step / 0.05))
    judged = (run.times >= run.times[0] + skipped)[:, None]
    off = np.where(judged, cells - predicted, np.nan)
    return {o: float(np.sqrt(np.nanmean(column**2))) for o, column in zip(rig.outputs, off.T, strict=True)}


def answer(study: Study, **more: Any) -> str:
    """Return the answer as JSON, to be opened after the verdict."""
    late = ("late",) if study.rig.late()[0] in study.truth else ()  # a fault, and an effect
    faults, sensors = [*study.recorder.faults, *late], list(study.rig.sensors)
    told = asdict(study) | {"faults": faults, "sensors": sensors, "error_true": true_error(study)}
    if study.half == "mixed":
        told["strangers"] = sorted(set(study.truth) & set(study.rig.outside))
    return json.dumps(told | more, indent=1) + "\n"
