"""Sealed logs that a refined FMU carries as experiments, with the errors before and after."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cosim.base.arrays import Array
from cosim.fmi.related_files import EXPERIMENTS, Experiment, RelatedFile, add_related, experiments_text
from cosim.logs.log import Log
from cosim.storage.csv_source import table_bytes

FILE, ERRORS = "sealed-logs.exp", "sealed-errors.json"


def carry_sealed_logs(fmus: Sequence[Path], logs: Sequence[Log], record: Mapping[str, Any]) -> None:
    """Add sealed logs, and the errors on them, to FMUs.

    Args:
        logs: Sealed logs, as pieces between pauses.
        record: Content of refine.json.
    """
    experiments: list[Experiment] = []
    more: dict[str, bytes] = {}
    for number, log in enumerate(logs, 1):
        stimuli, references = (f"sealed-{number}-{end}.csv" for end in ("in", "out"))
        more |= {stimuli: _table(log.time, log.inputs), references: _table(log.time, log.outputs)}
        title = log.path.stem if len(logs) == 1 else f"{log.path.stem} {number}"
        times = float(log.time[0]), float(log.time[-1]), log.step
        experiments.append(Experiment(title, "measured", *times, stimuli=stimuli, references=references))
    errors = {key: record[key] for key in ("verdict", "error", "noise_floor") if key in record}
    text = experiments_text("sealed logs", experiments, "Measured logs never used to choose or fit the model.")
    files = [
        (RelatedFile(FILE, "experiment/validation", EXPERIMENTS, "sealed logs of the refinement"), text),
        (
            RelatedFile(ERRORS, "report", "application/json", "errors on the logs, before and after the refinement"),
            json.dumps(errors, indent=2, ensure_ascii=False).encode(),
        ),
    ]
    for fmu in fmus:
        add_related(fmu, files, more)


def _table(time: Array, columns: Mapping[str, Array]) -> bytes:
    return table_bytes({"time": time.tolist(), **{name: column.tolist() for name, column in columns.items()}})
