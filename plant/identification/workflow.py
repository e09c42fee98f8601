"""Workflow of `cosim identify`: simulation or reading of a protocol, analysis, model file, identify.json, report."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.errors import Fault, InputError, refuse
from cosim.core.registry import is_model
from cosim.core.settings import Seed
from cosim.core.text import as_yaml, counted
from cosim.core.version import __version__
from cosim.files.artefact import Checking
from cosim.files.files import FilePath, check_writable, write_json, write_text
from cosim.files.folders import new_run, remove_earlier
from cosim.files.kinds import shell_path
from cosim.fmi.building.file import load_model, named_model
from cosim.model import SCALAR, Model
from plant.bench import Bench
from plant.identification.analyses import (
    after_sines,
    after_step,
    ground_effect_exponent,
    moment,
    projection,
    thrust_line,
)
from plant.identification.checks import planned_faults, recording_faults, result_faults
from plant.identification.craft import read_craft
from plant.identification.estimates import Estimate, Measurement, Result
from plant.identification.protocol import CELL_UNITS, Protocol, read_protocol
from plant.identification.recordings import Cells, Recording, calibrate, load_runs, play, read_recording, runs_of
from plant.identification.report import page
from plant.powertrain import ground_effect

IDENTIFY_RECORD, REPORT = "identify.json", "report.html"
# of a power-train
IDENTIFIED_PARAMETERS = {"thrust_offset", "thrust_slope", "ground_effect_exponent", "lag", "assembly_arm"}
# in order of dependence; a step test takes precedence for the lag
ANALYSES: Mapping[str, Callable[[Measurement], Result]] = {
    "step": after_step,
    "frequency": after_sines,
    "ground_effect": ground_effect_exponent,
    "thrust_line": thrust_line,
    "thrust_step": partial(after_step, thrust=True),
    "projection": projection,
    "moment": moment,
}
Progress = Callable[[str, float], None]
Recordings = Mapping[str, Sequence[Recording]]


@dataclass(frozen=True)
class Outcome:
    """Results of an identification; `model_file` has the model with the identified numbers."""

    results: Sequence[Result]
    model_file: Path

    @property
    def estimates(self) -> dict[str, Estimate]:
        """Return the estimates by `test.name`."""
        return {f"{r.test}.{e.name}": e for r in self.results for e in r.estimates}

    @property
    def warnings(self) -> list[str]:
        """Return the warnings, each with the name of its test."""
        return [f"{r.test}: {message}" for r in self.results for message in r.warnings]

    @property
    def sentences(self) -> list[str]:
        """Return a line for each estimate: value, confidence interval, value as in the thesis, true value."""
        lines = []
        for key, e in self.estimates.items():
            value = f"{e.value:.5g}" if e.unit == "1" else f"{e.value:.5g} {e.unit}"
            thesis = "no value" if np.isnan(e.thesis) else f"{e.thesis:.5g}"
            truth = "" if np.isnan(e.truth) else f"; true {e.truth:.6g}"
            lines.append(f"{key} = {value} (95 % {e.low:.5g} … {e.high:.5g}; by the thesis' method {thesis}{truth})")
        return lines

    @property
    def closing(self) -> str:
        """Return a sentence with the model file and the command that builds its FMU."""
        return f"model: {self.model_file}; build it with: cosim build --model {shell_path(self.model_file)}"


def identify(
    path: FilePath,
    out: FilePath | None = None,
    progress: Progress | None = None,
    *,
    report: bool = True,
    seed: Seed | None = None,
    force: bool = False,
) -> Outcome:
    """Identify a power-train, or noise and friction of a craft.

    Args:
        path: Protocol: tests on a bench or recordings of them, or logs of a craft (`rest`, `distance`).
        out: Folder for identify.json, report.html, and powertrain.yaml or model.yaml; None means a new number in
            results/NAME.
        progress: Function of (stage, completed share).
        report: Write report.html.
        seed: Seed for the noise of a simulated bench; None takes that of the protocol.
        force: Write into `out` even if it is not empty.

    Returns:
        Results of the tests with their intervals, or estimates of noise and friction.

    Raises:
        InputError: The protocol or its recordings have faults; the error names all of them.
    """
    path, calibrated = Path(path), list[Any]()
    if (craft := read_craft(path)) is not None:
        read = [path, *(log.path for log in (*craft.rest, *craft.runs))]
        name, file = craft.file.name, "model.yaml"
    else:
        protocol, model, measured = prepare(path)
        read = [path, *(r.path for recordings in measured.values() for r in recordings if r.path)]
        name, file = protocol.file.name, "powertrain.yaml"
    with new_run(out, name, "cosim identify", force=force) as place:
        check_writable(place, (file, IDENTIFY_RECORD, REPORT), read)
        if craft is not None:
            outcome, record = Outcome(craft.results(), place / file), dict[str, Any](name=name)
            recorded = counted(len(read) - 1, "log")
            identified = {e.name: e for r in outcome.results if r.test == "distance" for e in r.estimates}
            values = {**craft.loaded.parameters, **{n: e.value for n, e in identified.items()}}
            text = _model_text(craft.loaded.source, values, craft.loaded.sensors, identified, "runs")
        else:
            recordings, cells = _recorded(protocol, measured, protocol.file.seed if seed is None else seed, progress)
            outcome = Outcome(analyse(protocol, cells, recordings), place / file)
            refuse(result_faults(protocol, outcome.results))
            text = _powertrain(protocol, outcome, model)
            recorded = counted(sum(map(len, recordings.values())), "recording")
            record = {"protocol": name, "calibration": {c: cell.as_json() for c, cell in cells.items()}}
            calibrated = [(c, cells[c], protocol.load_in_si(c), protocol.file.cells[c].unit) for c in CELL_UNITS]
        shown = page(name, path, outcome.results, recorded, calibrated) if report else ""
        whole = {
            "schema_version": 1,
            "version": __version__,
            **record,
            "estimates": {key: e._asdict() for key, e in outcome.estimates.items()},
            "tests": {r.test: {**r.details, "notes": r.notes, "warnings": r.warnings} for r in outcome.results},
        }
        remove_earlier(place, read=read)
        write_text(outcome.model_file, text)
        plain = json.loads(json.dumps(whole), parse_constant=lambda _: None)  # null for missing numbers
        write_json(place / IDENTIFY_RECORD, plain, indent=1)
        if shown:
            write_text(place / REPORT, shown)
        return outcome


def check_protocol(path: Path, checking: Checking) -> list[str]:
    """Return the warnings of a protocol.

    Measured recordings and logs are analysed, so that impossible results are faults, as in `identify`.

    Raises:
        InputError: The protocol, or logs of a craft, have faults; the error names all of them.
    """
    if (craft := read_craft(path)) is not None:
        craft.results()
        return []
    protocol, _, measured = prepare(path)
    if not measured or not all(cell.points for cell in protocol.file.cells.values()):
        return []
    outcome = Outcome(analyse(protocol, calibrate(protocol, {}), measured), path)
    refuse(result_faults(protocol, outcome.results))
    return [f"warning: {message}" for message in outcome.warnings]


# -- input ----------------------------------------------------------------------------------


def prepare(path: Path) -> tuple[Protocol, Model, dict[str, list[Recording]]]:
    """Read a protocol, the model whose parameters it identifies, and the measured recordings by test.

    Raises:
        InputError: All faults of the protocol; if it has none, of the recordings; if they have none, of the model.
    """
    protocol = read_protocol(path)
    refuse(planned_faults(protocol))
    is_measured = all(cell.points for cell in protocol.file.cells.values())
    cells = calibrate(protocol, {}) if is_measured else None
    measured, faults = dict[str, list[Recording]](), list[Fault]()
    for name, test in protocol.file.tests.named_tests():
        unread = list[Fault]()
        for file in test.files:
            try:
                measured.setdefault(name, []).append(read_recording(protocol.yaml.path.parent / file))
            except InputError as error:
                unread += error.faults
        if cells is not None and test.files and not unread:
            unread = recording_faults(protocol, name, measured[name], cells)
        faults += unread
    refuse(faults)
    text = protocol.file.model
    model = named_model(text) if is_model(text) else load_model(text, protocol.yaml.path.parent, protocol.yaml).model
    if not IDENTIFIED_PARAMETERS & {p.name for p in model.parameters}:
        reason = f"{text} has none of {', '.join(sorted(IDENTIFIED_PARAMETERS))}, the identified parameters"
        refuse([protocol.yaml.fault(("model",), f"{reason}; give the model of the object on the bench")])
    return protocol, model, measured


def _recorded(
    protocol: Protocol, measured: Mapping[str, list[Recording]], seed: int, progress: Progress | None
) -> tuple[dict[str, list[Recording]], Cells]:
    """Return the recordings of all tests, simulated where not measured, and the calibrated cells."""
    hung, simulated = dict[str, list[Recording]](), dict[str, list[Recording]]()
    if protocol.file.bench is not None:
        names = [name for name, _ in protocol.file.tests.named_tests() if name not in measured]
        loads, runs = load_runs(protocol, seed), {name: runs_of(protocol, name, seed) for name in names}
        every = [run for group in (*loads.values(), *runs.values()) for run in group]
        total = sum(run.time.size for run in every) or 1
        tell = None if progress is None else (lambda done: progress("simulating the bench", done / total))
        played = iter(play(protocol.bench, every, tell))
        hung, simulated = (
            {n: [next(played) for _ in group] for n, group in groups.items()} for groups in (loads, runs)
        )
    cells = calibrate(protocol, hung)
    refuse(fault for name, runs in simulated.items() for fault in recording_faults(protocol, name, runs, cells))
    if progress is not None:
        progress("analysing", 0.0)
    return {**measured, **simulated}, cells


def analyse(protocol: Protocol, cells: Cells, recordings: Recordings) -> list[Result]:
    """Return the results in order of dependence.

    Numbers that a test needs come from earlier tests or, without these, from the protocol.
    """
    bench, truth = protocol.bench, protocol.bench if protocol.file.bench else None
    if truth is not None:  # estimated parameters must not be known
        blank = Bench()
        unknown = ("thrust_offset", "thrust_slope", "lag", "assembly_arm")
        bench = bench.with_values({n: getattr(blank, n) for n in unknown})
    results = []
    for name in (n for n in ANALYSES if n in recordings):
        result = ANALYSES[name](Measurement(recordings[name], cells, bench, getattr(protocol.file.tests, name), truth))
        results.append(result)
        # the lag of a step test has priority over that of sines
        if not (name == "frequency" and "step" in recordings):
            known = [e for e in result.estimates if e.name in bench.declared]
            bench = bench.with_values({e.name: float(np.clip(e.value, *bench.declared[e.name].bounds)) for e in known})
    return results


# -- model files ----------------------------------------------------------------------------


def _powertrain(protocol: Protocol, outcome: Outcome, model: Any) -> str:
    """Return a model.yaml with all identified numbers, intervals and origins, and the duty that gives equal thrust."""
    declared = {p.name for p in model.parameters}
    values = {n: v for n, v in protocol.file.parameters.items() if n in declared}
    chosen = dict[str, Estimate]()
    for e in outcome.estimates.values():
        if e.name in declared:
            chosen.setdefault(e.name, e)  # the lag of a step test has priority over that of sines
    values |= {n: e.value for n, e in chosen.items()}
    needed = {"duty_nominal", "height", "propeller_radius", "ground_effect_exponent", "thrust_offset", "thrust_slope"}
    if needed <= declared and needed & values.keys():  # eqs 4.20, 4.28
        after = model.with_values(values)
        before_gain, after_gain = (
            ground_effect(SCALAR, craft.height, craft.propeller_radius, craft.ground_effect_exponent)
            for craft in (model, after)
        )
        thrust = (model.thrust_offset + model.thrust_slope * model.duty_nominal) * before_gain  # [gf]
        values["duty_nominal"] = (thrust / after_gain - after.thrust_offset) / after.thrust_slope
    return _model_text(protocol.file.model, values, {}, chosen, "repetitions")


def _model_text(
    source: str,
    values: Mapping[str, Any],
    sensors: Mapping[str, Any],
    identified: Mapping[str, Estimate],
    repetitions: str,
) -> str:
    """Return a model.yaml with parameters, sensor errors, and interval, unit and origin of identified numbers.

    Args:
        source: Model from which the file derives.
        repetitions: Word after the number of repetitions, such as `runs`.
    """
    accuracy = {
        n: {"ci95": [e.low, e.high], "unit": e.unit, "origin": f"{e.origin}; {e.repetitions} {repetitions}"}
        for n, e in identified.items()
    }
    lines = ["schema_version: 1", f"model: {source}"]
    for key, content in (("parameters", values), ("sensors", sensors), ("identified", accuracy)):
        lines += [f"{key}:" if content else f"{key}: {{}}", *(f"  {n}: {as_yaml(v)}" for n, v in content.items())]
    return "\n".join(lines) + "\n"
