"""A run, in order: scenario → design → system → master → results → manifest → report."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.errors import SimulationError
from cosim.files import FilePath, check_writable
from cosim.results import Results
from cosim.simulation.criteria import evaluate
from cosim.simulation.design import designed_values
from cosim.simulation.manifest import check_pinned, manifest, write_manifest
from cosim.simulation.master import StoppedRun, simulate
from cosim.simulation.nearest import take_nearest
from cosim.simulation.scenario_file import ScenarioFile
from cosim.simulation.system import build_system


@dataclass(frozen=True)
class Outcome:
    """A run that is written down."""

    results: Results
    manifest: dict[str, Any]
    folder: Path

    @property
    def missed(self) -> list[dict[str, Any]]:
        """Criteria that are not met."""
        return [c for c in self.manifest["criteria"] if not c["met"]]


def run(
    scenario: FilePath,
    folder: FilePath,
    overrides: Sequence[str] = (),
    *,
    nearest: bool = False,
    report: bool = True,
    figures: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Outcome:
    """Run a scenario, or repeat a manifest, and leave results.csv, manifest.json and report.html in `folder`.

    nearest: FMUs and the model of the design that a refine left give way to those that came nearest in it.
    Raises InputError, FmuError; and SimulationError after the rows so far are written.
    """
    began = time.perf_counter()
    file, folder = ScenarioFile(Path(scenario), overrides), Path(folder)
    if nearest:
        take_nearest(file)
    check_pinned(file)
    designed = designed_values(file)
    system = build_system(file, designed)
    check_writable(folder, ("results.csv", "manifest.json", "report.html"), file.files)
    loaded = time.perf_counter()
    steps = file.scenario.steps
    failure: SimulationError | None = None
    try:
        results = simulate(system, steps, file.scenario.step, progress and (lambda k: progress(k, steps)))
    except StoppedRun as stopped:
        results, failure = stopped.results, stopped.error
    simulated = time.perf_counter()
    timings = {
        "load": loaded - began,
        "simulate": simulated - loaded,
        "real_time_factor": file.scenario.duration / (simulated - loaded),
    }
    record = manifest(file, designed, system, timings)
    if failure is None:
        record["criteria"] = evaluate(file.scenario, results)
    else:
        record["status"] = f"failed: {failure}"
    record["warnings"] += results.notes
    record["warnings"] += [
        f"{s.component.name}: {text}" for s in system.stages for text in getattr(s.component, "log", ())
    ]
    _write(folder, results, record, report=report, figures=figures)
    if failure is not None:
        raise failure
    return Outcome(results, record, folder)


def _write(folder: Path, results: Results, record: dict[str, Any], *, report: bool, figures: bool) -> None:
    """What a run leaves, whether or not it came to its end."""
    (folder / "report.html").unlink(missing_ok=True)  # an earlier one would be of another run
    results.write_csv(folder / "results.csv")
    write_manifest(folder / "manifest.json", record)
    if report:
        from cosim.simulation.report import write_report

        write_report(folder / "report.html", results, record)
    if figures:
        from cosim.simulation.report import write_figures

        write_figures(folder / "figures", results, record)
