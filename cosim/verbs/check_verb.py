"""`cosim check` and `cosim.check`: find every fault of files."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import typer

from cosim.core.drafts import is_full
from cosim.core.errors import (
    Crashed,
    Fault,
    FmuError,
    InputError,
    Interrupted,
    NotExecuted,
    Signalled,
    Terminated,
    refuse,
)
from cosim.core.messages import with_prefix
from cosim.core.program import STOPPED
from cosim.core.registry import resolve
from cosim.core.settings import Files, Given, ModelName
from cosim.files.artefact import Checking, kind_by_keys, of_kind
from cosim.files.files import FilePath
from cosim.verbs.cli import say, say_json

CHECKED_KINDS = "a scenario, study, sweep, protocol, model, log, SSP or FMU"
MOST_LINES = 200  # printed without --json


def check(
    files: FilePath | Files,
    model: ModelName | None = None,
    *,
    load: bool = True,
    compile: bool = False,
    columns: Given | None = None,
) -> list[str]:
    """Find every fault of files.

    Args:
        files: One file or several: scenarios, studies, sweeps, protocols, models, logs, SSPs, FMUs.
        model: Model of the logs (base, a model.yaml, file.py:Class). By default a log with an input of the base model
            belongs to that model, and another log is checked alone.
        load: Load FMUs and make one step, and execute Python files that are named, in a worker process. False executes
            nothing.
        compile: Compile and execute the sources of FMUs that have no library for this machine.
        columns: Column of the logs → variable, or "time".

    Returns:
        Notes and warnings, one line each.

    Raises:
        InputError: Every fault of all files.
    """
    from cosim.blocks.compiling import compiling, permission
    from cosim.isolation.process import Worker
    from cosim.logs.log import read_column_names
    from cosim.master.remote import MODULES

    faults: list[Fault] = []
    lines: list[str] = []
    paths = [*map(Path, [files] if isinstance(files, (str, os.PathLike)) else files)]
    first = paths[0] if paths else Path("columns")
    names = columns if isinstance(columns, Mapping) else read_column_names(columns or (), first)
    with compiling(compile):
        if permission.get() and not load:
            text = "is to load FMUs, which --no-load (in Python load=False) forbids; leave one of them out"
            raise InputError.at(Path("--compile"), text)
        with Worker(*MODULES) if load else nullcontext() as worker:
            checking = Checking(model, dict(names), worker)
            for path in paths:
                try:
                    lines += [with_prefix(f"{path}: ", line) for line in _check_isolated(path, checking)]
                except InputError as error:
                    faults += error.faults
    refuse(faults)
    return lines


def _check_isolated(path: Path, checking: Checking) -> list[str]:
    """Check a file; execute named Python in the worker, or not at all without a worker."""
    from cosim.fmi.building.file import without_execution

    worker = checking.worker
    with without_execution() as skipped:
        try:
            return _check(path, checking)
        except NotExecuted as code:
            if worker is None:
                return [f"warning: {code} (--no-load); that file and everything that depends on it are not checked"]
        except InputError:
            if worker is None or not skipped:  # else there may be more faults
                raise
    try:
        lines: list[str] = worker.call(_check, path, replace(checking, worker=None))
    except Crashed as crash:
        reason = crash.reason.replace("the worker", "its Python", 1)
        raise InputError.at(skipped[0], f"does not load: {reason}") from None
    return lines


def _check(path: Path, checking: Checking) -> list[str]:
    """Return the notes of a file; raise InputError with its faults."""
    from cosim.files import artefact, kinds
    from cosim.files.yaml_file import YamlFile

    kind: str | None = artefact.CODE
    if not path.suffix.startswith(".py:"):  # FILE.py:Class
        kinds.refuse_unreadable(path, CHECKED_KINDS)
        kind = kinds.kind_by_form(path)
    if kind is None:
        root = YamlFile(path).root
        is_study = root.keys() & {"model", "candidates"} and "step" not in root  # one that forgets its logs
        kind = kind_by_keys(root) or (artefact.STUDY if is_study else artefact.SCENARIO)
    declared = of_kind(kind)
    if declared is None or not declared.check:
        raise InputError.at(path, f"is {kind}, in which there is nothing to check: {kinds.next_step(kind, path)}")
    notes: list[str] = resolve(declared.check)(path, checking)
    return notes


def command(*, json: bool = False, **given: Any) -> None:
    """Find every fault of scenarios, studies, models, logs and FMUs.

    Args:
        files (FILE): Scenario, study, sweep, protocol, model, log, SSP, FMU or manifest.json.
        model (MODEL): Model of the logs: base, a model.yaml, or FILE.py:CLASS.
        load: Load the FMUs and make one step in a separate process, or do not.
        columns (--column COLUMN=VARIABLE): Name of a log's column in the model, or time.

    Example: cosim check scenario.yaml build/*.fmu
    """
    files = given["files"]
    try:
        lines = check(**given)
    except (Signalled, Terminated) as error:
        raise FmuError(error.reason if isinstance(error, Signalled) else str(error)) from None
    except (Interrupted, KeyboardInterrupt):
        raise typer.Exit(STOPPED) from None
    except OSError as error:
        if not is_full(error):
            raise
        raise FmuError("the disk is full, so that no FMU can be tried; --no-load checks without") from None
    say(*lines[:MOST_LINES])
    if len(lines) > MOST_LINES:
        say(f"… and {len(lines) - MOST_LINES} more; --json lists all of them")
    say(f"no fault in {', '.join(map(str, files))}")
    if json:
        say_json({"files": [str(file) for file in files], "findings": lines, "faults": []})
