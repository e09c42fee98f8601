"""Workflow of a fit: logs → gate → drives → estimate → replays → files. Sealed logs are simulated at the end only."""

from __future__ import annotations

import os
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cosim.blocks.compiling import compiling, permission
from cosim.calibration.estimate import Estimate
from cosim.calibration.fit_study import Parameter, Request, candidates, read_vary, request_of
from cosim.calibration.fitted import Fitted
from cosim.calibration.fitted_fmu import deliver
from cosim.calibration.likelihood import Logs, OutOfTime
from cosim.calibration.outcome import Part, prove, write_record
from cosim.core.errors import Fault, FmuError, InputError, SimulationError, Terminated, TimedOut, refuse, stop_error
from cosim.core.messages import Note
from cosim.core.settings import Files, Given, Names, column_names, texts
from cosim.core.text import did_you_mean, join_names, showing
from cosim.files.artefact import Checking
from cosim.files.files import FilePath, check_writable, hold_stops, named_path, one_stop, write_json, write_text
from cosim.files.folders import name_of_file, remove_earlier, results_in
from cosim.fmi.description import display_units, read_description, unit_definition, unit_of
from cosim.isolation.process import Worker
from cosim.logs.gate import gate, gate_faults
from cosim.logs.log import Log
from cosim.probing.own_step import probe_own_step
from cosim.probing.prober import LIMITS
from cosim.residuals.drive import MODULES, Drive, DriveApart, check_files, log_of_fmu, start_values
from cosim.residuals.residual_statistics import FREE_RUN
from cosim.ssp.write import write_parameter_set

FILES = ("fit.json", "fitted.ssv", "fitted.fmu", "report.html")


def fit(
    logs: FilePath | Files,
    fmu: FilePath | None = None,
    out: FilePath | None = None,
    *,
    vary: Given | None = None,
    start: Given | None = None,
    sealed: Files = (),
    per_log: Names = (),
    profile: Names = (),
    columns: Given | None = None,
    report: bool = True,
    force: bool = False,
    in_process: bool = False,
    compile: bool = False,
    limits: str = "",
    progress: Callable[[str, float], None] | None = None,
) -> Fitted:
    """Estimate parameters and start values of an FMU from measured logs.

    Args:
        logs: Logs of the estimate, or a study file, which names them and the FMU.
        fmu: FMU whose parameters are estimated.
        out: Folder for fit.json, fitted.ssv, fitted.fmu and report.html; None writes nothing.
        vary: Parameter → None, "20%", "LOW..HIGH" or (low, high), or texts as on the command line. By default those
            of the study, or those that the logs determine.
        start: Further value of the FMU, or first value of a parameter → value.
        sealed: Logs for the proof, which the estimate does not use.
        per_log: Parameters with a value for each log, such as a load that changes between logs.
        profile: Parameters whose likelihood is profiled, for intervals that need not be symmetric.
        columns: Column of the logs → variable, or "time".
        report: Write report.html.
        force: Write even if the folder is not empty; results in it are replaced.
        in_process: Load the FMU into this process, for a debugger; limits do not apply.
        compile: Compile and execute the sources of an FMU that has no library for this machine.
        limits: Limits of time and memory, for example "step: 10 s, total: 1 h"; `total` limits the estimate.
        progress (in Python): Function of (stage, share).

    Returns:
        Estimates with 95 % intervals, and the errors before and after.

    Raises:
        InputError: Every fault of the input.
        FmuError: An FMU cannot be read or loaded.
        SimulationError: The FMU fails with the values before the fit, or a limit is reached; the best values so far
            are in `out`.
    """
    request = request_of(
        [logs] if isinstance(logs, (str, os.PathLike)) else list(logs),
        fmu,
        vary=texts(vary),
        start=texts(start),
        sealed=list(sealed),
        per_log=list(per_log),
        profile=list(profile),
        columns=column_names(columns),
        limits=limits,
    )
    name = name_of_file(request.fmu if request.yaml is None else request.yaml.path, "fit")
    progress = progress or (lambda stage, share: None)
    begin = time.monotonic()
    most, path = request.limits, request.fmu
    with (
        compiling(compile),
        results_in(out, "cosim fit", name, force=force) as folder,
        one_stop(),
        ExitStack() as stack,
    ):
        place = named_path(folder)
        read, chosen, given, fixed = _read(request)
        display = display_units([read_description(path)])
        stack.enter_context(showing({"display": display}))
        files = [*request.logs, path, *([request.yaml.path] if request.yaml else [])]
        check_writable(place, FILES, files)
        progress("probing the FMU", 0.0)
        if not in_process:
            _refuse_own_step(request, read[0], given)
        worker = None if in_process else stack.enter_context(Worker(*MODULES))
        inner = most.model_copy(update={"total": None, "step": most.step or most.total})

        def load(log: Log, file: Path = path) -> AbstractContextManager[Drive]:
            return DriveApart(worker, log, file, limits=inner, given=fixed) if worker else Drive(log, file, given=fixed)

        drives = [stack.enter_context(load(log)) for log in read]
        _refuse_bad(drives)
        opened, closed = drives[: len(request.estimation)], drives[len(request.estimation) :]
        estimate, parts = Estimate(Logs(opened, begin + (most.total or np.inf)), progress), list[Part]()
        stop: SimulationError | None = None
        stage = "the fit"
        try:
            estimate.run(chosen, screening=not request.vary, profiled=request.profile)
            stage = "the proof"
            progress("replaying with the values before and after", 0.0)
            assert estimate.likelihood is not None
            varied, x = {p.name for p in chosen}, estimate.likelihood.best.x
            horizon = estimate.logs.horizon or FREE_RUN
            first = {p.name: p.start for p in chosen if not p.is_start}
            every = [estimate.likelihood.values(x, k) for k in range(len(opened))]
            own = [{n: v for n, v in each.items() if n in varied} for each in every]
            proved = [prove(opened, [first] * len(opened), own, horizon, sealed=False)]
            if closed:  # sealed logs, with the mean of each value
                mean = {n: float(np.mean([each[n] for each in own])) for n in own[0]}
                proved.append(prove(closed, [first] * len(closed), [mean] * len(closed), horizon, sealed=True))
            parts = proved  # none if the proof is stopped
        except OutOfTime:
            reached = f"the limit of {most.total:g} s (limits: total) is reached"
            stop = TimedOut("the fit", 0.0, f"{reached}; the best values so far are written, without proof")
        except SimulationError as error:
            if stage == "the fit":
                raise
            stop = error
        except (KeyboardInterrupt, Terminated) as signal:
            if estimate.likelihood is None:
                raise
            stop = stop_error(signal, 0.0, stage)
        if estimate.likelihood is None:
            assert stop is not None
            raise stop
        hold_stops()
        record = write_record(request, estimate, parts, fixed, time.monotonic() - begin)
        record.display = display
        record.notes += [f"{log.path.name}: {text}" for log in read for text in log.assumed]
        if request.unused:
            unused = f"`cosim fit` does not use {join_names(request.unused)}: `cosim refine` does"
            record.warnings.insert(0, unused)
        remove_earlier(place, read=files)
        values = {name: entry.value for name, entry in record.parameters.items()}
        likelihood, point = estimate.likelihood, estimate.likelihood.best
        if len(opened) == 1:  # named start values of a single log may be start values of the FMU
            each = zip(likelihood.unknowns, point.x.tolist(), strict=True)
            values |= {u.name: v for u, v in each if u.log is not None and not u.spread}
        described = read_description(path)
        units = {v.name: unit_of(v) for v in described.modelVariables}
        sets = {n: v for n, v in fixed.items() if isinstance(v, float)} | values
        definitions = {u: d for u in {units[n] for n in sets} if (d := unit_definition(described, u)) is not None}
        pairs = {n: (v, units[n]) for n, v in sets.items()}
        write_parameter_set(place / "fitted.ssv", f"{path.stem}-fitted", pairs, definitions)
        if stop is None and values:
            start = {n: v for n, v in likelihood.values(point.x, 0).items() if n not in values}
            way, reason = deliver(drives[0], values, start, place / "fitted.fmu", lambda file: load(read[0], file))
            if way == "wrapped":
                record.notes.append(f"fitted.fmu holds the FMU in a wrapper that sets the values: {reason}")
            elif not way:
                words = ["cosim", "simulate", str(path)]
                words += [word for n, v in values.items() for word in ("--set", f"{n}={v!r}")]
                command = shlex.join([*words, *(["--compile"] if permission.get() else [])])
                record.warnings.append(f"no fitted.fmu: {reason}. fitted.ssv has the values; `{command}` sets them")
        write_json(place / "fit.json", record.model_dump(mode="json"), allow_nan=False)
        if report and out is not None:
            from cosim.calibration.report import page

            write_text(place / "report.html", page(record, estimate, parts))
    if stop is not None:
        stop.left = place
        raise stop
    warnings = *record.warnings, *map(Note, record.notes)
    return Fitted(record.model_dump(mode="json"), None if out is None else folder, warnings)


def check_fit_study(path: Path, checking: Checking) -> list[str]:
    """Return what a fit of a study will estimate.

    Raises:
        InputError: The study has faults.
        FmuError: Only the FMU has faults.
    """
    request = request_of([path], None)
    logs, chosen, given, fixed = _read(request)
    if checking.worker is not None:
        with ExitStack() as stack:
            apart = [DriveApart(checking.worker, g, request.fmu, limits=request.limits, given=fixed) for g in logs]
            _refuse_bad([stack.enter_context(drive) for drive in apart])
        _refuse_own_step(request, logs[0], given)
    aim = "" if request.vary else "what the logs determine of "
    return [Note(f"`cosim fit` will estimate {aim}{join_names([p.name for p in chosen])}")]


def _read(request: Request) -> tuple[list[Log], list[Parameter], dict[str, Any], dict[str, Any]]:
    """Return logs, parameters to estimate, given values, and those of them that are not estimated.

    Raises:
        InputError: Every fault of logs and arguments.
        FmuError: Only the FMU has faults.
    """
    fmu, logs, yaml = request.fmu, request.logs, request.yaml
    faults: list[Fault] = []

    def attempt(function: Callable[..., Any], default: Any, *arguments: Any) -> Any:
        try:
            return function(*arguments)
        except InputError as error:
            faults.extend(error.faults)
            return default

    if yaml is not None:
        beside = "does not exist; file names are relative to the study"
        if not fmu.is_file():
            faults.append(yaml.fault(("model",), f"{yaml.root['model']} {beside}"))
        faults += [request.log_fault(k, f"{p.name} {beside}") for k, p in enumerate(logs) if not p.exists()]
    paths = [p for p in logs if not faults or p.exists()]
    if not request.estimation:
        message = "names no log to estimate from; name at least one"
        faults.append(request.fault(("logs",), message, Path("LOG")))
    faults += [
        request.log_fault(k, "is named twice; a log is used once, for the estimate or as a sealed log")
        for k, p in enumerate(logs)
        if p in logs[:k]
    ]
    refuse(faults if yaml is not None and not fmu.exists() else ())
    for path in paths or [fmu]:
        attempt(check_files, None, path, fmu)
    refuse(faults if any(f.file == fmu for f in faults) or {f.file for f in faults} >= {*paths} else ())
    description = read_description(fmu)
    given = attempt(start_values, {}, fmu, request.start, lambda n, text: request.fault(("start", n), text))

    def choose() -> list[Parameter]:
        numbers = {n: v for n, v in given.items() if isinstance(v, (int, float)) and not isinstance(v, bool)}
        offered = candidates(description, numbers)
        own = read_vary(description, offered, request.per_log, lambda n, text: request.fault(("per_log",), text))
        if request.vary:
            chosen = read_vary(description, offered, request.vary, lambda n, text: request.fault(("vary", n), text))
        else:
            every = (p for p in offered.values() if not p.is_start and p.name not in given)
            chosen = [p for p in every if p.low <= p.start <= p.high]
            if not chosen:
                message = "has no parameter to estimate: no floating-point parameter with a start value may be set"
                raise InputError.at(fmu, f"{message} before a run")
        named = {p.name: p for p in (*own, *chosen)}
        return [replace(p, per_log=True) if n in {o.name for o in own} else p for n, p in named.items()]

    def read(path: Path) -> Log:
        return log_of_fmu(path, fmu, request.columns, alone=len(paths) == 1)

    chosen: list[Parameter] = attempt(choose, [])
    read_logs = [attempt(read, None, path) for path in paths]
    varied = {p.name for p in chosen}
    for k, name in enumerate(request.profile if chosen else ()):
        if name not in {p.name for p in chosen if not p.per_log}:
            message = f"{name} is no parameter that is estimated for all logs{did_you_mean(name, varied)}"
            faults.append(request.fault(("profile", k), f"{message}; name it as --vary too"))
    refuse(faults)
    return read_logs, chosen, given, {n: v for n, v in given.items() if n not in varied}


def _refuse_own_step(request: Request, log: Log, given: Mapping[str, Any]) -> None:
    """Raise InputError if the FMU makes steps of its own that are longer than those of a log."""
    numbers = {n: v for n, v in given.items() if isinstance(v, float)}
    try:
        own = probe_own_step(request.fmu, [log], numbers, limits=request.limits if request.limits.step else LIMITS)
    except (FmuError, SimulationError):
        return  # the first simulation reports it
    if own and own.distorts:
        raise InputError.at(
            request.fmu,
            (
                f"its co-simulation takes steps of its own of about {own.length:.3g} s, above the {log.step:.3g} s "
                "of the logs, so its results are wrong there; export it with a shorter step, or record rows every "
                f"{own.length:.3g} s"
            ),
        )


def _refuse_bad(drives: Sequence[Drive]) -> None:
    """Refuse logs with faults of clock, units or channels; every fault of every log at once."""
    faults: list[Fault] = []
    for drive in drives:
        faults += gate_faults(drive.log, gate(drive.log, drive.rate, drive.traits, starts=drive.starts))
    refuse(faults)
