"""Workflow of a linearization: model or FMU → point → derivatives → reduction → linear.json, .mat, .py, page."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from cosim.blocks.compiling import compiling
from cosim.core.errors import Fault, InputError, refuse
from cosim.core.registry import BASE, is_model
from cosim.core.settings import Given, Names, Positive, texts
from cosim.core.text import did_you_mean
from cosim.files.artefact import CODE, FMU, MODEL
from cosim.files.files import FilePath, check_writable, named_path, write_text
from cosim.files.folders import new_run, remove_earlier
from cosim.files.kinds import check_given, kind_of
from cosim.fmi.building.file import load_model
from cosim.fmi.building.refined import names_refine, refined_file
from cosim.linearization.linear_model import missing_states, select, structure
from cosim.linearization.linear_model import residualize as residualize_states
from cosim.linearization.point import move, points_along, read_at
from cosim.linearization.sources import (
    LINEARIZATION_MODULES,
    EquationSource,
    ExchangeSource,
    Source,
    settle,
    with_parameters,
)
from cosim.linearization.write import LINEARIZATION_FILES, Outcome, write
from cosim.residuals.drive import start_values


def linearize(
    model: FilePath,
    out: FilePath | None = None,
    *,
    at: Given = (),
    set: Given = (),
    states: Names = (),
    inputs: Names = (),
    outputs: Names = (),
    residualize: Names = (),
    component: str = "",
    step: Positive | None = None,
    report: bool = True,
    force: bool = False,
    compile: bool = False,
) -> Outcome:
    """Linearize a model or an FMU about an operating point.

    Args:
        model: Registered model, model.yaml, file.py:Class, folder of a refine, or an FMU for model exchange.
        out: Folder for linear.json, linear.mat, linear.py and report.html; None writes nothing.
        at: State or input → value, or texts NAME=VALUE, SCENARIO@TIME, SCENARIO@START:STOP:STEP. By default the start.
        set: Parameter → value, or texts NAME=VALUE.
        states: States of the linear model, in this order.
        inputs: Inputs of the linear model.
        outputs: Outputs of the linear model.
        residualize: Fast states that are replaced by their equilibrium.
        component: Component of the scenario, if several match.
        step: Step of central differences, which replace the directional derivatives of an FMU.
        report: Write report.html.
        force: Write even if the folder is not empty.
        compile: Compile and execute the sources of an FMU that has no library for this machine.

    Returns:
        The linear models, their structure and notes.

    Raises:
        InputError: The input is wrong; the error names all faults.
        FmuError: An FMU cannot be read or loaded.
        SimulationError: The simulation failed.
    """
    values = texts(set)
    at_values, scenario, times = read_at(texts(at))
    folder = None if out is None else named_path(out)
    with ExitStack() as stack:
        stack.enter_context(compiling(compile))
        source = _source(stack, Path(model), values, step)
        faults: list[Fault] = []
        for option, chosen, names in (
            ("states", states, source.states),
            ("inputs", inputs, source.inputs),
            ("outputs", outputs, source.outputs),
            ("residualize", residualize, source.states),
        ):
            kind = "state" if names is source.states else option.removesuffix("s")
            for name in chosen:
                if name not in names:
                    text = f'{source.title} has no {kind} "{name}"{did_you_mean(name, names)}'
                    faults.append(Fault(Path(f"--{option}"), 0, 0, text))
        text = "is also selected by --states; remove it from one of the two"
        faults += [Fault(Path("--residualize"), 0, 0, f"{name} {text}") for name in residualize if name in states]
        refuse(faults)
        states, inputs, outputs = ([*dict.fromkeys(chosen)] for chosen in (states, inputs, outputs))
        states = states or [n for n in source.states if n not in residualize]
        inputs, outputs = inputs or source.inputs, outputs or source.outputs
        if folder is not None:
            stack.enter_context(new_run(folder, "", "cosim linearize", force=force))
            check_writable(folder, (*LINEARIZATION_FILES, "report.html"), source.files)
        if scenario is None:
            points, notes = [source.start], list[str]()
        else:
            source, points, notes = points_along(source, scenario, times, component, values)
        try:
            points = [settle(source, move(source, point, at_values), residualize) for point in points]
            reduced = [residualize_states(each, residualize) for each in source.linear(points)]
        except ValueError as error:
            raise InputError.at(Path("--residualize"), str(error)) from None
        if others := dict.fromkeys(n for each in reduced for n in missing_states(each, states)):
            text = f"the selected states depend on {', '.join(others)}"
            cure = "add them, or if they are fast, give them as --residualize"
            raise InputError.at(Path("--states"), f"{text}; {cure}")
        linear = [select(each, states, inputs, outputs) for each in reduced]
        effects = np.max([np.abs(np.vstack([m.B, m.D])).max(axis=0, initial=0.0) for m in linear], axis=0)
        idle = [name for name, effect in zip(inputs, effects, strict=True) if effect == 0.0]
        notes += [f"{name} has no effect at this point, perhaps because of a dead band or a stop" for name in idle]
        notes += [n for n in dict.fromkeys(n for each in linear for n in each.notes) if n not in notes]
        outcome = Outcome(str(model), source.title, tuple(linear), structure(linear[0]), tuple(notes), folder)
        if folder is not None:
            remove_earlier(folder, read=source.files)
            write(folder, outcome)
            if report:
                from cosim.linearization.report import page

                write_text(folder / "report.html", page(outcome))
        return outcome


def _source(stack: ExitStack, path: Path, values: Sequence[str], step: float | None) -> Source:
    """Return the source for a model name or file."""
    text, option = str(path), Path("--step")
    if not is_model(text) and text != BASE and ".py:" not in text and not names_refine(path):
        if path.exists():
            check_given(path, MODEL, FMU, CODE)
        if kind_of(path) == FMU:
            from cosim.blocks.summary import read_fmus
            from cosim.isolation.process import Worker

            if step is not None and not 0.0 < step < 1.0:
                raise InputError.at(option, f"{step:g} is not between 0 and 1; give a small number, such as 1e-5")
            (description,) = read_fmus([path])
            start = start_values(path, values, lambda name, message: Fault(Path("--set"), 0, 0, message))
            return ExchangeSource(stack.enter_context(Worker(*LINEARIZATION_MODULES)), path, description, start, step)
    if step is not None:
        raise InputError.at(option, "applies to FMUs only: equations are differentiated exactly; remove it")
    loaded = load_model(text if is_model(text) else str(refined_file(path)), Path())
    return EquationSource(replace(loaded, model=with_parameters(loaded.model, values)), text)
