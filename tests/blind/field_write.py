"""Files of a study of the field half: study.yaml, the plant's model file, two estimation logs and a sealed log.

    python -m tests.blind.field_write 3 /tmp/study      seed and folder; prints the answer

The answer contains `error_true`, the root mean square error of the true model on the sealed log by channel.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from tests.blind.field_craft import CraftRig, craft, replay_craft
from tests.blind.field_rig import Course, Run
from tests.blind.field_study import LOGS, Study, course, draw, noise, replace_pushes, rows_to_keep, stream

PLANTS = Path(__file__).with_name("plants")
SKIPPED = 2.0  # [s] of rows of 50 ms and faster that are not judged at the start of a log; longer where rows are slower
SEALED = LOGS.index("v1")


def recorded(study: Study, number: int) -> tuple[Run, Course, np.ndarray]:
    """Return log `number`: its inputs, its course, and the recorded cells, NaN if missing."""
    run, result = course(study, number)
    spoiling = stream(study.seed, 10 + number, 5)
    cells = study.recorder.spoil(spoiling, study.rig, result.readings, noise(study, number), study.stamp_error)
    return run, result, np.where(rows_to_keep(study, number), cells, np.nan)


def write(study: Study, folder: Path) -> Path:
    """Write study.yaml, the model file and the logs, without the answer; return the path of study.yaml."""
    write_logs(study, folder)
    if study.plant != "craft":
        shutil.copyfile(PLANTS / f"{study.plant}.py", folder / f"{study.plant}.py")
    path = folder / "study.yaml"
    path.write_text(study_yaml(study))
    return path


def write_logs(study: Study, folder: Path) -> None:
    """Write the logs of a study."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, name in enumerate(LOGS):
        (folder / f"{name}.csv").write_text(_csv(study, *recorded(study, number)))


def study_yaml(study: Study) -> str:
    """Return the study file, independent of hidden effects; tolerances are in the plant's own file."""
    logs = "logs:\n  estimation: [e1.csv, e2.csv]\n  validation: [v1.csv]\n"
    if study.plant != "craft":
        return f"model: {study.plant}.py:{study.rig.model}\n{logs}"
    tolerance = ", ".join(f"{name}: {share:g}" for name, (_, share) in study.rig.sheet.items())
    return f"model: base\n{logs}tolerance: {{{tolerance}}}\n"


def _csv(study: Study, run: Run, _: Course, cells: np.ndarray) -> str:
    """Return the log as CSV without rows that are lost as a whole."""
    lines = [",".join(("time", *study.rig.inputs, *study.rig.outputs))]
    whole = study.recorder.whole_rows
    for t, command, row in zip(run.times.tolist(), run.commands.tolist(), cells.tolist(), strict=True):
        if whole and all(map(math.isnan, row)):
            continue
        written = [f"{u:.6g}" for u in command] + ["" if math.isnan(v) else f"{v:.7g}" for v in row]
        lines.append(f"{t:.6f}," + ",".join(written))
    return "\n".join(lines) + "\n"


def true_error(study: Study) -> dict[str, float]:
    """Return the root mean square of recorded − true model on the sealed log, by channel.

    The true model starts at the true state once per horizon, with the true sensor errors and without disturbance. Cells
    are those of the log, outliers included.
    """
    run, result, cells = recorded(study, SEALED)
    predicted = _replayed(study, run, result)
    skipped = SKIPPED * max(1.0, math.ceil(study.rig.step / 0.05))
    judged = (run.times >= run.times[0] + skipped)[:, None]
    off = np.where(judged, cells - predicted, np.nan)
    return {o: float(np.sqrt(np.nanmean(column**2))) for o, column in zip(study.rig.outputs, off.T, strict=True)}


def _replayed(study: Study, run: Run, result: Course) -> np.ndarray:
    """Return predictions of the true model, restarted from the true state at the start of each horizon."""
    rig = study.rig
    if isinstance(rig, CraftRig):
        made = craft(study.base, study.kind, study.truth)
        right = replay_craft(made, run, result, rig)
        p = rig.numbers({}, study.truth)
        if made.outside.compass:
            right[:, 0] = [made.outside.compass(psi) for psi in right[:, 0]]
        return np.column_stack([rig.sensed(p, o, column) for o, column in zip(rig.outputs, right.T, strict=True)])
    horizon = round(rig.horizon / rig.step)
    resets = {k: result.states[k] for k in range(0, run.times.size, horizon)}
    p = rig.numbers(study.base, study.truth)
    return rig.course(p, replace_pushes(run), resets).readings


def answer(study: Study) -> str:
    """Return the answer as JSON, to be opened after the verdict."""
    told: dict[str, Any] = {"half": "field"} | asdict(study)
    told |= {"faults": list(study.faults), "sensors": list(study.rig.sensors), "error_true": true_error(study)}
    return json.dumps(told, indent=1) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.blind.field_write", description=__doc__.splitlines()[0])
    parser.add_argument("seed", type=int)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args(arguments)
    study = draw(options.seed)
    print(write(study, options.folder), file=sys.stderr)
    print(answer(study), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
