"""Experiments that an FMU carries, run and compared with their expected results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cosim.authoring.draft import write_single
from cosim.authoring.parts import parts_of
from cosim.base.errors import CosimError, Fault, FmuError, InputError
from cosim.base.messages import Message
from cosim.base.text import amount, counted
from cosim.blocks.clocks import read_clocks
from cosim.blocks.summary import experiment_of
from cosim.comparison.differences import Compared, compare_runs, describe_largest
from cosim.fmi.related_files import FOLDER, Experiment, member_of
from cosim.related import messages
from cosim.related.expected_results import in_form_of
from cosim.simulation.run_files import RecordedRun, read_ran
from cosim.simulation.workflow import run
from cosim.ssp.parameter_sets import read_parameter_file
from cosim.ssp.ssp_package import Package

MAX_LISTED = 5  # names of signals in a message
LIMITS = {"limits.step": 60.0, "limits.total": 600.0}  # [s] of an experiment, which may be too long for its FMU
TOLERANCE = 0.01  # share of a signal's range; FMI-LS-REF defines none
VALIDATION = "experiment/validation"  # role of measured results, which no FMU reproduces within TOLERANCE
NOT_MET = 5  # exit code
MOST_INNER_STEPS = 1e10  # of 60 ns each they would take all of LIMITS


@dataclass(frozen=True)
class Carried:
    """An experiment of an FMU.

    Attributes:
        fmu: The FMU.
        folder: Folder into which the FMU is unpacked.
        base: Folder within the archive that its URIs are relative to.
        role: Role of the file that describes it.
    """

    fmu: Path
    folder: Path
    experiment: Experiment
    base: str = FOLDER
    role: str = "experiment"

    @property
    def title(self) -> str:
        """Return the name for messages."""
        return f'experiment "{self.experiment.name}"'

    def path(self, uri: str) -> Path | None:
        """Return the unpacked file of a URI; None for "" or a URI outside the archive."""
        member = member_of(self.base, uri)
        return None if member is None else self.folder / member


def run_experiment(carried: Carried, out: Path) -> tuple[list[str], list[Fault]]:
    """Run an experiment in a folder and compare it with its expected results.

    Returns:
        Notes, and the faults: a failure, or deviations beyond the tolerance.
    """
    failed, notes = messages.FAILED, list[str]()
    try:
        results = _simulate(carried, out)
        notes += results.warnings
        failed = messages.NOT_COMPARED
        references = carried.path(carried.experiment.references)
        if references is None:
            return [*notes, messages.NOTHING_EXPECTED(experiment=carried.title)], []
        expected = read_ran(references)
        rows, missing = in_form_of(results.results, expected.results)
        if missing and not (rows.columns or rows.exact):
            raise InputError.at(references, messages.NOTHING_COMMON(names=_some(missing)))
        told, faults = _judge(carried, compare_runs(replace(expected, results=rows), results, TOLERANCE))
        if missing:
            about = {"count": counted(len(missing), "signal"), "names": _some(missing)}
            notes.append(messages.NOT_IN_FMU(experiment=carried.title, **about).after("warning: "))
        return [*notes, *told], faults
    except CosimError as error:
        message = failed.around(_within(carried, str(error)), experiment=carried.title)
        code = FmuError.exit_code if isinstance(error, InputError) else error.exit_code  # its files are part of the FMU
        return notes, [Fault(carried.fmu, 0, 0, message, code)]


def _some(names: Sequence[str]) -> str:
    """Return the first names as a list."""
    return ", ".join(names[:MAX_LISTED]) + (", …" if len(names) > MAX_LISTED else "")


def _simulate(carried: Carried, out: Path) -> RecordedRun:
    """Return the run of an experiment, with the FMU's own names of signals."""
    asked = carried.experiment
    parameters, stimuli = carried.path(asked.parameters), carried.path(asked.stimuli)
    package = Package(carried.fmu, carried.folder, carried.folder, packed=True)
    start = {} if parameters is None else read_parameter_file(package, str(parameters.relative_to(carried.folder)))
    (part,) = parts_of([carried.fmu])
    ticks, driven = ({}, False) if stimuli is None else _ticks_in(stimuli, carried.fmu, part.description)
    path, _ = write_single(out, carried.fmu, start, stimuli if driven else None, stop=asked.stop, step=asked.step)
    settings: dict[str, Any] = LIMITS | {
        "start_time": asked.start,
        f"components.{part.name}.tolerance": asked.tolerance,
    }
    if notes := _too_fine(part.description, carried):
        settings[f"components.{part.name}.interface"] = "model-exchange"
    settings |= {f"components.{part.name}.clocks.{name}": {"at": times} for name, times in ticks.items()}
    changes = [f"{key}={value}" for key, value in settings.items() if value is not None]
    results = run(path, out, changes, report=False).results
    prefix = f"{part.name}."
    columns = tuple(name.removeprefix(prefix) for name in results.columns)
    exact = {name.removeprefix(prefix): values for name, values in results.exact.items()}
    units = {name.removeprefix(prefix): unit for name, unit in results.units.items()}
    rows = replace(results, columns=columns, exact=exact, units=units)
    return RecordedRun(carried.fmu, "the FMU", rows, warnings=notes)


def _ticks_in(stimuli: Path, fmu: Path, description: Any) -> tuple[dict[str, list[float]], bool]:
    """Return the times at which stimuli tick each triggered input clock, and whether they drive other inputs.

    A clock ticks at each row in which its column is not 0.
    """
    clocks = read_clocks(fmu, description).values()
    names = {clock.name for clock in clocks if clock.causality == "input" and not clock.is_time_based}
    if not names:
        return {}, True
    rows = read_ran(stimuli).results
    driven = any(name not in names for name in (*rows.columns, *rows.exact))
    return {name: rows.time[rows[name] > 0.0].tolist() for name in rows.columns if name in names}, driven


def _too_fine(description: Any, carried: Carried) -> tuple[Message, ...]:
    """Return a note if co-simulation would take too many internal steps, and the FMU offers model exchange."""
    step = getattr(description.coSimulation, "fixedInternalStepSize", None)
    declared, asked = experiment_of(description), carried.experiment
    begin, end = (asked.start or declared.get("start", 0.0)), (asked.stop or declared.get("stop", 0.0))
    if not step or description.modelExchange is None or (end - begin) / float(step) < MOST_INNER_STEPS:
        return ()
    return (messages.BY_MODEL_EXCHANGE(experiment=carried.title, count=(end - begin) / float(step), step=float(step)),)


def _judge(carried: Carried, compared: Compared) -> tuple[list[str], list[Fault]]:
    """Return the comparison with the expected results as notes or as a fault."""
    title, differences = carried.title, compared.ranking
    if carried.role == VALIDATION:
        rms = {name: float(np.sqrt(np.nanmean((b - a) ** 2))) for name, (a, b) in compared.values.items()}
        errors = ", ".join(f"{d.name} {amount(rms[d.name], d.unit)}" for d in compared.differences if d.name in rms)
        return [messages.MEASURED(experiment=title, errors=errors)], []
    largest = describe_largest(differences[0]) if differences[0].largest else "no difference"
    if compared.same:
        count = counted(len(differences), "signal")
        return [messages.REPRODUCED(experiment=title, count=count, share=100 * TOLERANCE, largest=largest)], []
    reasons = _within(carried, ", ".join(compared.reasons))
    message = messages.DEVIATES(experiment=title, reasons=reasons, largest=largest)
    return [], [Fault(carried.fmu, 0, 0, message, NOT_MET)]


def _within(carried: Carried, text: str) -> str:
    """Return a text with the names of files as they are in the archive."""
    return text.replace(f"{carried.folder}/", "")


def with_default(fmu: Path, folder: Path, source: str, part: str = "") -> Carried:
    """Return the default experiment of an FMU with a file of expected results.

    Args:
        part: Name that tells several files of expected results apart.
    """
    name = f"default experiment, {part}" if part else "default experiment"
    return Carried(fmu, folder, Experiment(name, references=source), role="result")


def labels_text(labels: Sequence[tuple[str, str]]) -> str:
    """Return labels for a message."""
    return "".join(f", {name}" for name, _ in labels)
