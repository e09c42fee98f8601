"""Workflow of `cosim identify`: simulation or reading of a protocol, analysis, powertrain.yaml, report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.errors import refuse
from cosim.base.registry import model_entry, resolve
from cosim.base.scratch import temporary_folder
from cosim.base.settings import Seed
from cosim.model import Model
from cosim.storage.artefact import Checking
from cosim.storage.files import FilePath, check_writable
from cosim.storage.folders import new_run
from cosim.storage.kinds import check_given
from plant.bench import Bench
from plant.identification import frequency, ground_effect, lag, moment, projection, thrust_line
from plant.identification.artefacts import PROTOCOL
from plant.identification.cells import Cells, calibrate
from plant.identification.checks import recording_faults
from plant.identification.craft import CraftOutcome, craft_file, read_craft
from plant.identification.craft_workflow import identify_craft
from plant.identification.estimates import Estimate, Measurement, Result
from plant.identification.identified import Outcome
from plant.identification.plausible import result_faults
from plant.identification.prepared import prepare
from plant.identification.protocol import BENCH, Protocol
from plant.identification.recordings import FmuPlayer, Recording, SimulatedRecording, load_runs, runs_of
from plant.identification.write import RECORD, REPORT, model_text, write

FILES = ("powertrain.yaml", RECORD, REPORT)
# in order of dependence; the lag of a step is that of the model
ANALYSES: Mapping[str, Callable[..., Result]] = {
    "step": lag.analyse,
    "frequency": frequency.analyse,
    "ground_effect": ground_effect.analyse,
    "thrust_line": thrust_line.analyse,
    "thrust_step": partial(lag.analyse, thrust=True),
    "projection": projection.analyse,
    "moment": moment.analyse,
}
Progress = Callable[[str, float], None]


def identify(
    path: FilePath,
    out: FilePath,
    progress: Progress | None = None,
    *,
    report: bool = True,
    seed: Seed | None = None,
    force: bool = False,
) -> Outcome | CraftOutcome:
    """Identify a power-train, or noise and friction of a craft.

    Args:
        path: Protocol: tests on a bench or recordings of them, or logs of a craft (`rest`, `distance`).
        out: Folder for identify.json, report.html, and powertrain.yaml or model.yaml.
        progress: Function of (stage, completed share).
        report: Write report.html.
        seed: Seed for the noise of a simulated bench; None takes that of the protocol.
        force: Write into `out` even if it is not empty.

    Returns:
        Results of the tests with their intervals, or estimates of noise and friction.

    Raises:
        InputError: Every fault of the protocol and its recordings.
    """
    path = Path(path)
    check_given(path, PROTOCOL)
    with new_run(out, "", "cosim identify", force=force) as place:
        if (yaml := craft_file(path)) is not None:
            return identify_craft(yaml, place, report=report)
        ready = prepare(path)
        protocol, measured = ready.protocol, ready.measured
        named = [path, *(protocol.folder / f for _, test in protocol.file.tests.named_tests() for f in test.files)]
        check_writable(place, FILES, named)
        outcome = _outcome(protocol, measured, protocol.file.seed if seed is None else seed, progress)

        def page() -> str:
            from plant.identification.report import page

            return page(outcome)

        model = (FILES[0], powertrain(outcome, ready.model))
        write(place, model, _record(outcome), outcome.results, page if report else None, read=named)
        return outcome


def _outcome(
    protocol: Protocol, measured: Mapping[str, list[Recording]], seed: int, progress: Progress | None
) -> Outcome:
    """Simulate unmeasured tests and return the results."""
    hung: dict[str, list[Recording]] = {}
    simulated: dict[str, list[Recording]] = {}
    if protocol.file.bench is not None:
        tests = [name for name, _ in protocol.file.tests.named_tests() if name not in measured]
        runs = {name: runs_of(protocol, name, seed) for name in tests}
        hung, simulated = _on_fmu(protocol, load_runs(protocol, seed), runs, progress=progress)
    cells = calibrate(protocol, hung)
    refuse(fault for name, runs in simulated.items() for fault in recording_faults(protocol, name, runs, cells))
    if progress is not None:
        progress("analysing", 0.0)
    recordings = {**measured, **simulated}
    return Outcome(protocol, cells, checked_results(protocol, cells, recordings), recordings)


Runs = Mapping[str, Sequence[SimulatedRecording]]


def _on_fmu(protocol: Protocol, *groups: Runs, progress: Progress | None) -> list[dict[str, list[Recording]]]:
    """Simulate groups of runs on the FMU."""
    total = sum(run.time.size for group in groups for runs in group.values() for run in runs) or 1
    tell = None if progress is None else (lambda done: progress("playing the bench", done / total))
    with temporary_folder("identify") as folder:
        player = FmuPlayer(_fmu(protocol, folder), protocol.file.parameters, tell)
        try:
            return [{name: player(runs) for name, runs in group.items()} for group in groups]
        finally:
            player.close()


def _fmu(protocol: Protocol, folder: Path) -> Path:
    """Return the FMU of the bench: built now, or named in the protocol."""
    if protocol.file.bench != BENCH:
        return protocol.folder / str(protocol.file.bench)
    from cosim.fmi.fmu_build import build

    return build(resolve(model_entry(BENCH).recipe)(), folder / "bench.fmu")


def analyse(
    protocol: Protocol, cells: Cells, recordings: Mapping[str, Sequence[Recording]], *, draw: bool = True
) -> list[Result]:
    """Return the results in order of dependence.

    Unknown numbers come from earlier tests, else from the protocol.
    """
    bench, truth = protocol.bench, protocol.bench if protocol.is_simulated else None
    if truth is not None:  # estimated parameters must not be known
        blank = Bench()
        bench = bench.with_values(
            {n: getattr(blank, n) for n in ("thrust_offset", "thrust_slope", "lag", "assembly_arm")}
        )
    results = []
    for name in (n for n in ANALYSES if n in recordings):
        measured = Measurement(recordings[name], cells, bench, getattr(protocol.file.tests, name), truth)
        result = ANALYSES[name](measured, draw=draw)
        results.append(result)
        # the lag of a step test has priority over that of sines
        fresh = {e.name: _in_bounds(bench, e) for e in result.estimates if e.name in bench.declared}
        if not (name == "frequency" and "step" in recordings):
            bench = bench.with_values(fresh)
    return results


def checked_results(
    protocol: Protocol, cells: Cells, recordings: Mapping[str, Sequence[Recording]], *, draw: bool = True
) -> list[Result]:
    """Return all tests' results, checked for plausibility.

    Raises:
        InputError: Every impossible number.
    """
    results = analyse(protocol, cells, recordings, draw=draw)
    refuse(result_faults(protocol, results))
    return results


def check_protocol(path: Path, checking: Checking) -> list[str]:
    """Return the warnings of a protocol.

    Measured recordings are analysed, so that impossible numbers are faults as in `identify`.

    Raises:
        InputError: Every fault of the protocol, or of logs of a craft.
    """
    if (yaml := craft_file(path)) is not None:
        read_craft(yaml)
        return []
    ready = prepare(path)
    protocol, measured = ready.protocol, ready.measured
    if not measured or not all(cell.points for cell in protocol.file.cells.values()):
        return []
    results = checked_results(protocol, calibrate(protocol, {}), measured, draw=False)
    return [f"warning: {r.test}: {message}" for r in results for message in r.warnings]


def _in_bounds(bench: Bench, e: Estimate) -> float:
    low, high = bench.declared[e.name].bounds
    return float(np.clip(e.value, low, high))


# -- results ------------------------------------------------------------------------------


def _record(outcome: Outcome) -> dict[str, Any]:
    return {
        "protocol": outcome.protocol.file.name,
        "calibration": {
            c: {
                "loads": cell.loads.tolist(),
                "volts": cell.volts.tolist(),
                "error": cell.error,
                "left_one_out": cell.cross_validation_errors.tolist(),
                "at_the_rail": list(cell.saturated_loads),
            }
            for c, cell in outcome.cells.items()
        },
    }


def powertrain(outcome: Outcome, model: Model) -> str:
    """Return a model.yaml with every identified number, its interval and origin."""
    protocol = outcome.protocol
    declared = {p.name for p in model.parameters}
    values = {n: v for n, v in protocol.file.parameters.items() if n in declared}
    chosen = {n: e for n, e in outcome.estimates_by_name.items() if n in declared}
    values |= {n: e.value for n, e in chosen.items()}
    values |= _hovering(model, values)
    return model_text(protocol.file.model, values, {}, chosen, "repetitions")


def _hovering(model: Model, values: Mapping[str, float]) -> dict[str, float]:
    """Return the nominal duty of equal thrust, eqs 4.20, 4.28."""
    needed = {"duty_nominal", "height", "propeller_radius", "ground_effect_exponent", "thrust_offset", "thrust_slope"}
    base: Any = model
    if not needed <= {p.name for p in model.parameters} or not needed & set(values):
        return {}
    from cosim.model import SCALAR
    from plant.powertrain import ground_effect as gain

    after: Any = model.with_values(values)
    before_gain = gain(SCALAR, base.height, base.propeller_radius, base.ground_effect_exponent)
    thrust = (base.thrust_offset + base.thrust_slope * base.duty_nominal) * before_gain  # [gf]
    after_gain = gain(SCALAR, after.height, after.propeller_radius, after.ground_effect_exponent)
    return {"duty_nominal": (thrust / after_gain - after.thrust_offset) / after.thrust_slope}
