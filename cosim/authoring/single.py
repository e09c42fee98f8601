"""A run of a single FMU, with a scenario.yaml written for it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

from cosim.authoring.draft import write_single
from cosim.authoring.parts import parts_of
from cosim.base.errors import Fault, refuse
from cosim.base.text import split_assignment
from cosim.blocks.summary import read_fmus
from cosim.simulation.workflow import Outcome, WriteReport, run
from cosim.storage.files import FilePath
from cosim.storage.folders import new_run
from cosim.storage.yaml_file import short
from cosim.storage.yaml_nodes import Document, NotYaml


def simulate(
    fmu: FilePath,
    folder: FilePath | None = None,
    *,
    start: Mapping[str, Any] | Sequence[str] = (),
    recorded: FilePath | None = None,
    stop: float | None = None,
    step: float | None = None,
    record: Sequence[str] = (),
    interpolation: str = "held",
    report: WriteReport | Literal[False] = False,
    force: bool = True,
    in_process: bool = False,
    format_: str = "csv",
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Outcome, tuple[str, ...]]:
    """Run an FMU over its default experiment.

    Writes scenario.yaml, results.csv, manifest.json and the report. After a failure the rows so far are written before
    the error is raised.

    Args:
        start: Start values of parameters and inputs, as a mapping or NAME=VALUE texts.
        recorded: CSV whose columns drive the inputs of the same names.
        stop: Stop time [s], like `step` in place of the default experiment's.
        record: Locals and parameters to record besides inputs and outputs.
        interpolation: Values of `recorded` between two rows: held or linear.

    Returns:
        The outcome and notes.

    Raises:
        InputError: The input is faulty.
        FmuError: The FMU does not load.
        SimulationError: The simulation stopped early.
    """
    path = Path(fmu)
    _check_times(path, stop, step)
    (description,) = read_fmus([path])
    values = start if isinstance(start, Mapping) else start_pairs(path, start, description)
    csv = None if recorded is None else Path(recorded)
    with new_run(folder, parts_of([path])[0].name, "cosim simulate", force=force) as place:
        scenario, notes = write_single(
            place, path, values, csv, stop=stop, step=step, record=record, interpolation=interpolation
        )
        settings: dict[str, Any] = {"in_process": in_process, "format_": format_, "progress": progress}
        outcome = run(scenario, place, report=report, command="cosim simulate", **settings)
    return outcome, notes


def _check_times(fmu: Path, stop: float | None, step: float | None) -> None:
    faults = []
    if stop is not None and not math.isfinite(stop):
        faults.append(Fault(fmu, 0, 0, f"--stop {stop:g}: give a number of seconds"))
    if step is not None and not (math.isfinite(step) and step > 0):
        faults.append(Fault(fmu, 0, 0, f"--step {step:g}: give a number of seconds above 0"))
    refuse(faults)


def start_pairs(fmu: Path, texts: Sequence[str], description: Any) -> dict[str, Any]:
    """Return start values from NAME=VALUE texts; text stays as written."""
    names = {v.name for v in description.modelVariables}
    words = {v.name for v in description.modelVariables if v.type in {"String", "Binary"}}
    values: dict[str, Any] = {}
    faults = []
    for text in texts:
        name, sign, value = split_assignment(text, names)
        if not sign or not name:
            faults.append(Fault(fmu, 0, 0, f'--set "{short(text)}" is not NAME=VALUE; for example --set mass=2'))
            continue
        values[name] = value
        if name not in words:
            with suppress(NotYaml):
                values[name] = Document(value).data
    refuse(faults)
    return values
