"""Workflow of a fit: logs → checks → drives → estimate → replays → files. Sealed logs are simulated only at the end."""

from __future__ import annotations

import os
import shlex
import time
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cosim.blocks.compiling import compiling, permission
from cosim.calibration.estimate import Estimate
from cosim.calibration.fit_study import FitInput, Request, read_input, request_of
from cosim.calibration.fitted import Fitted
from cosim.calibration.likelihood import Logs, OutOfTime
from cosim.calibration.outcome import Part, credibility_of, prove, write_record
from cosim.core.drafts import draft_of
from cosim.core.errors import FmuError, InputError, SimulationError, Terminated, TimedOut, refuse, stop_error
from cosim.core.messages import Note
from cosim.core.settings import Files, Given, Names, texts
from cosim.core.text import join_names, showing
from cosim.credibility.record import attach
from cosim.files.archive import DESCRIPTION, description_of
from cosim.files.artefact import Checking
from cosim.files.files import FilePath, check_writable, hold_stops, named_path, one_stop, write_json, write_text
from cosim.files.folders import name_of_file, remove_earlier, results_in
from cosim.fmi.description import display_units, read_description, unit_definition, unit_of
from cosim.fmi.native.compiler import CompilerFailed, NoCompiler
from cosim.fmi.wrapping.wrap import CannotWrap, parsed, set_starts, wrap, xml_of
from cosim.isolation.process import Worker
from cosim.logs.gate import gate, gate_faults
from cosim.probing.places import probe_own_step
from cosim.probing.prober import LIMITS
from cosim.residuals.drive import REPLAY_MODULES, Drive, DriveApart, drive_in
from cosim.ssp.write import write_parameter_set
from cosim.terms.code import TermCode

EQUAL_OUTPUTS_SHARE = 1e-9  # difference of outputs relative to their range
FIT_FILES = ("fit.json", "fitted.ssv", "fitted.fmu", "report.html")


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
        logs: Logs for the estimate, or a study file, which names logs and FMU.
        fmu: FMU whose parameters are estimated.
        out: Folder for fit.json, fitted.ssv, fitted.fmu and report.html; None writes nothing.
        vary: Parameter → None, "20%", "LOW..HIGH" or (low, high), or texts as on the command line. By default those
            of the study, or those that the logs determine.
        start: Further value of the FMU, or first value of a parameter → value.
        sealed: Logs for the final check, not used by the estimate.
        per_log: Parameters with a value for each log, such as a load that changes between logs.
        profile: Parameters whose likelihood is profiled, for asymmetric intervals.
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
        InputError: The input is wrong; the error names all faults.
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
        columns=columns,
        limits=limits,
    )
    name = name_of_file(request.fmu if request.yaml is None else request.yaml.path, "fit")
    progress = progress or (lambda stage, share: None)
    begin, most, path = time.monotonic(), request.limits, request.fmu
    with (
        compiling(compile),
        results_in(out, "cosim fit", name, force=force) as folder,
        one_stop(),
        ExitStack() as stack,
    ):
        place, given = named_path(folder), read_input(request)
        described = read_description(path)
        display = display_units([described])
        stack.enter_context(showing({"display": display}))
        files = [*request.logs, path, *([request.yaml.path] if request.yaml else [])]
        check_writable(place, FIT_FILES, files)
        progress("probing the FMU", 0.0)
        if not in_process:
            _refuse_own_step(request, given)
        worker = None if in_process else stack.enter_context(Worker(*REPLAY_MODULES))
        inner = most.model_copy(update={"total": None, "step": most.step or most.total})
        load = partial(drive_in, worker, limits=inner, given=given.fixed)
        drives = [stack.enter_context(load(log, path)) for log in given.logs]
        _refuse_bad(drives)
        estimation_drives, sealed_drives = drives[: len(request.estimation)], drives[len(request.estimation) :]
        estimate, parts = Estimate(Logs(estimation_drives, begin + (most.total or np.inf)), progress), list[Part]()
        stop: SimulationError | None = None
        stage = "the fit"
        try:
            estimate.run(given.parameters, screening=not request.vary, profiled=request.profile)
            stage = "the proof"
            progress("replaying with the values before and after the fit", 0.0)
            sets = [(estimation_drives, False), (sealed_drives, True)]
            parts = [prove(given.parameters, estimate, of, sealed=sealed) for of, sealed in sets if of]
        except OutOfTime:
            reached = f"the limit of {most.total:g} s (limits: total) is reached"
            stop = TimedOut("the fit", 0.0, f"{reached}; the best values so far are written, without final check")
        except (SimulationError, KeyboardInterrupt, Terminated) as error:
            is_failure = isinstance(error, SimulationError)
            has_no_result = stage == "the fit" if is_failure else estimate.likelihood is None
            if has_no_result:
                raise
            stop = stop_error(error, 0.0, stage)
        if estimate.likelihood is None:
            assert stop is not None
            raise stop
        hold_stops()
        record = write_record(request, estimate, parts, given.fixed, time.monotonic() - begin)
        record.display = display
        record.notes += [f"{log.path.name}: {text}" for log in given.logs for text in log.assumed]
        remove_earlier(place, read=files)
        values = {name: entry.value for name, entry in record.parameters.items()}
        likelihood, x = estimate.likelihood, estimate.likelihood.best.x
        if len(estimation_drives) == 1:  # named start values of a single log may be start values of the fitted FMU
            each = zip(likelihood.unknowns, x.tolist(), strict=True)
            values |= {u.name: v for u, v in each if u.log is not None and not u.spread}
        all_values = {n: v for n, v in given.fixed.items() if isinstance(v, float)} | values
        units = {v.name: unit_of(v) for v in described.modelVariables if v.name in all_values}
        definitions = {u: d for u in set(units.values()) if (d := unit_definition(described, u)) is not None}
        pairs = {n: (v, units[n]) for n, v in all_values.items()}
        write_parameter_set(place / "fitted.ssv", f"{path.stem}-fitted", pairs, definitions)
        if stop is None and values:
            start = {n: v for n, v in likelihood.values(x, 0).items() if n not in values}
            way, reason = deliver(drives[0], values, start, place / "fitted.fmu", partial(load, drives[0].log))
            if way == "wrapped":
                record.notes.append(f"fitted.fmu contains the FMU in a wrapper that sets the values: {reason}")
            elif not way:
                words = ["cosim", "simulate", str(path)]
                words += [word for n, v in values.items() for word in ("--set", f"{n}={v!r}")]
                command = shlex.join([*words, *(["--compile"] if permission.get() else [])])
                record.warnings.append(f"no fitted.fmu: {reason}. fitted.ssv has the values; `{command}` sets them")
            if way and parts:
                progress("measuring error bands", 0.0)
                every = [likelihood.values(x, k) for k in range(len(estimation_drives))]
                kept = [{n: v for n, v in each.items() if n in values} for each in every]
                try:
                    known, record.coverage = credibility_of(record, likelihood, estimation_drives, sealed_drives, kept)
                    attach(place / "fitted.fmu", known)
                except (SimulationError, FmuError) as error:
                    record.warnings.append(f"fitted.fmu has no record of credibility: {error}")
        content = record.model_dump(mode="json")
        write_json(place / "fit.json", content, allow_nan=False)
        if report and out is not None:
            from cosim.calibration.report import page

            write_text(place / "report.html", page(record, request, estimate, parts))
    if stop is not None:
        stop.left = place
        raise stop
    return Fitted(content, None if out is None else folder, (*record.warnings, *map(Note, record.notes)))


def check_fit_study(path: Path, checking: Checking) -> list[str]:
    """Return a note on the parameters that a fit of the study will estimate.

    Raises:
        InputError: The study has faults.
        FmuError: Only the FMU has faults.
    """
    request = request_of([path], None)
    given = read_input(request)
    if checking.worker is not None:
        with ExitStack() as stack:
            more: Any = {"limits": request.limits, "given": given.fixed}
            apart = [DriveApart(checking.worker, log, request.fmu, **more) for log in given.logs]
            _refuse_bad([stack.enter_context(drive) for drive in apart])
        _refuse_own_step(request, given)
    aim = "" if request.vary else "the identifiable parameters among "
    return [Note(f"`cosim fit` will estimate {aim}{join_names([p.name for p in given.parameters])}")]


def _refuse_own_step(request: Request, given: FitInput) -> None:
    """Raise InputError if the FMU has an internal step that is longer than the step of a log."""
    numbers, log = {n: v for n, v in given.given.items() if isinstance(v, float)}, given.logs[0]
    try:
        own = probe_own_step(request.fmu, [log], numbers, limits=request.limits if request.limits.step else LIMITS)
    except (FmuError, SimulationError):
        return  # the first simulation will report it
    if own:
        message = (
            f"its co-simulation has an internal step of about {own.length:.3g} s, above the step of {log.step:.3g} s "
            "of the logs, so its results are wrong; export it with a shorter step, or record rows every "
            f"{own.length:.3g} s"
        )
        raise InputError.at(request.fmu, message)


def _refuse_bad(drives: Sequence[Drive]) -> None:
    """Raise InputError with the faults of clock, units or channels of all logs."""
    findings = ((d.log, gate(d.log, d.rate, d.traits, starts=d.starts)) for d in drives)
    refuse(fault for log, found in findings for fault in gate_faults(log, found))


# -- the FMU with fitted start values --------------------------------------------------------------


# The FMU is copied, with new start values in modelDescription.xml, if its library uses them. Otherwise a wrapper sets
# the values, as in a refined FMU, which needs a compiler.


def deliver(
    drive: Drive,
    values: Mapping[str, float],
    start: Mapping[str, float],
    path: Path,
    load: Callable[[Path], AbstractContextManager[Drive]],
) -> tuple[str, str]:
    """Write an FMU with other start values that behaves like the original with these values set.

    The new FMU is simulated without setting values, and compared with the original.

    Args:
        drive: Drive of the original over a log.
        start: Start values of the log, set in both simulations.
        load: Function that returns a drive of an FMU over the log, as a context manager.

    Returns:
        The method: "copied", "wrapped" or "" for failure; and the reason why it was not copied, or why it failed.
    """
    last, reason = drive.log.rows - 1, ""
    wanted = drive.run(0, last, {**start, **values})
    span = np.maximum(np.ptp(wanted, axis=0) + 1e-300, np.abs(wanted).max(axis=0))
    for way in ("copied", "wrapped"):
        try:
            if way == "copied":
                _write_copy(drive.fmu, values, path)
            else:
                wrap(drive.fmu, TermCode("", (), hooks=()), values, path)
            with load(path) as made:
                actual = made.run(0, last, start)
        except (CannotWrap, NoCompiler, CompilerFailed) as error:
            reason += f"{'; ' if reason else ''}{error}"
            continue
        except (SimulationError, FmuError):
            actual = np.full_like(wanted, np.nan)
        if np.all(np.abs(actual - wanted) <= EQUAL_OUTPUTS_SHARE * span):
            return way, reason
        if way == "copied":
            reason = "the library ignores the start values of modelDescription.xml"
        else:
            reason += "; a wrapper that sets the values does not behave like the FMU with the values set"
    path.unlink(missing_ok=True)
    return "", reason


def _write_copy(fmu: Path, values: Mapping[str, float], path: Path) -> None:
    """Write a copy of an FMU with other start values; all other files are unchanged, with their dates.

    Raises:
        CannotWrap: A variable has no start value.
    """
    root = parsed(description_of(fmu))
    set_starts(root, values, fmu.name)
    with draft_of(path) as draft, zipfile.ZipFile(fmu) as old, zipfile.ZipFile(draft, "w") as new:
        for member in old.infolist():
            content = xml_of(root) if member.filename == DESCRIPTION else old.read(member)
            new.writestr(member, content, member.compress_type)
