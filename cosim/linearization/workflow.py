"""Workflow of a linearization: model or FMU → point → derivatives → reduction → linear.json, .mat, .py, page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cosim.authoring.single import start_pairs
from cosim.base.errors import Fault, InputError, refuse
from cosim.base.messages import Note
from cosim.base.registry import BASE, is_model
from cosim.base.settings import Given, Positive, texts
from cosim.blocks.compiling import compiling
from cosim.linearization.along import Along
from cosim.linearization.fmu_source import MODULES, ExchangeSource, typed_values
from cosim.linearization.kinks import OUTPUT, RATE, SIDES, STEPS_OFF_KINK, Kink
from cosim.linearization.linear_model import Linear, Point, missing_states, select
from cosim.linearization.linear_model import residualize as residualize_states
from cosim.linearization.linear_sources import EquationSource, LinearizableSystem, settle
from cosim.linearization.point import AT, move, read_at
from cosim.linearization.result import Outcome
from cosim.linearization.set_parameters import with_parameters
from cosim.linearization.system_structure import structure
from cosim.linearization.write import FILES, write
from cosim.loading.file import LoadedModel, load_model, named_model
from cosim.loading.refined import names_refine, refined_file
from cosim.storage.files import FilePath, check_writable, named_path, write_text
from cosim.storage.folders import new_run, remove_earlier
from cosim.storage.kinds import CODE, FMU, MODEL, check_given, kind_of
from cosim.storage.yaml_file import did_you_mean

MAX_KINK_NOTES = 10


@dataclass(frozen=True)
class Selection:
    """Selection of states, inputs and outputs of a linear model; an empty list selects all.

    Attributes:
        fast: States to eliminate at their steady state.
    """

    states: Sequence[str] = ()
    inputs: Sequence[str] = ()
    outputs: Sequence[str] = ()
    fast: Sequence[str] = ()


def linearize(
    model: FilePath,
    out: FilePath | None = None,
    *,
    at: Given = (),
    set: Given = (),
    states: Sequence[str] = (),
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
    residualize: Sequence[str] = (),
    component: str = "",
    step: Positive | None = None,
    side: str | None = None,
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
        side: Side of a kink whose derivative is used, "below" or "above". Without it a kink is refused.
        report: Write report.html.
        force: Write into `out` even if it is not empty.
        compile: Compile and execute the sources of an FMU that has no library for this machine.

    Returns:
        The linear models, their structure and notes.

    Raises:
        InputError: Every fault of the input.
        FmuError: An FMU cannot be read or loaded.
        SimulationError: The simulation failed.
    """
    if side is not None and side not in SIDES:
        cure = did_you_mean(side, tuple(SIDES))
        raise InputError.at(Path("--side"), f'"{side}" is not a side of a kink; give below or above{cure}')
    values = texts(set)
    where, folder = read_at(texts(at, "at")), None if out is None else named_path(out)
    selection = Selection(states, inputs, outputs, residualize)
    with ExitStack() as stack:
        stack.enter_context(compiling(compile))
        source = _source(stack, Path(model), values, step)
        selection = _complete(source, selection)
        if folder is not None:
            stack.enter_context(new_run(folder, "", "cosim linearize", force=force))
            check_writable(folder, (*FILES, "report.html"), source.files)
        notes: list[str] = []
        if where.moment is None:
            points = [source.start()]
        else:
            along = Along(source, where.moment, component)
            source = source.with_values(along.start_values, values)
            points, notes = along.points(source), along.notes
        points = [move(source, point, where.values) for point in points]
        linear = _linear(source, points, selection, side)
        notes += _notes(linear, notes)
        if side is not None and not any(each.kinks for each in linear):
            notes.append(
                Note(
                    f"--side {side} has no effect: the chosen states, inputs and outputs have the same slopes on both "
                    "sides here"
                )
            )
        outcome = Outcome(str(model), source.title, tuple(linear), structure(linear[0]), tuple(notes), folder)
        if folder is not None:
            remove_earlier(folder, "cosim linearize", read=source.files)
            write(folder, outcome)
            if report:
                from cosim.linearization.report import page

                write_text(folder / "report.html", page(outcome))
        return outcome


def _notes(linear: Sequence[Linear], notes: Sequence[str]) -> list[str]:
    """Return further notes: idle inputs, slopes at kinks, notes of the models."""
    effects = np.max([np.abs(np.vstack([m.B, m.D])).max(axis=0, initial=0.0) for m in linear], axis=0)
    more: list[str] = [
        Note(f"{n} moves nothing at this point: a dead band or a stop, perhaps")
        for n, effect in zip(linear[0].inputs, effects, strict=True)
        if effect == 0.0
    ]
    kinks = [Note(f"{k.description}; the slopes here are those {k.side}") for each in linear for k in each.kinks]
    more += kinks[:MAX_KINK_NOTES]
    if len(kinks) > MAX_KINK_NOTES:
        more.append(Note(f"{len(kinks) - MAX_KINK_NOTES} kinks more; linear.json has all"))
    own = dict.fromkeys(n for each in linear for n in each.notes) if linear[0].notes else ()
    return [*more, *(n for n in own if n not in (*notes, *more))]


def _source(stack: ExitStack, path: Path, values: Sequence[str], step: float | None) -> LinearizableSystem:
    """Return the source for a model name or file."""
    text = str(path)
    if not is_model(text) and text != BASE and ".py:" not in text and not names_refine(path):
        if path.exists():
            check_given(path, MODEL, FMU, CODE)
        if kind_of(path) == FMU:
            return _fmu(stack, path, values, step)
    if step is not None:
        raise InputError.at(Path("--step"), "is of FMUs only: equations are differentiated exactly; leave it out")
    if is_model(text):
        loaded = LoadedModel(named_model(text), text)
    else:
        loaded = load_model(str(refined_file(path) if names_refine(path) else text), Path())
    return EquationSource(replace(loaded, model=with_parameters(loaded.model, values)), text)


def _fmu(stack: ExitStack, path: Path, values: Sequence[str], step: float | None) -> LinearizableSystem:
    from cosim.blocks.summary import read_fmus
    from cosim.isolation.process import Worker

    if step is not None and not 0.0 < step < 1.0:
        raise InputError.at(Path("--step"), f"{step:g} is not between 0 and 1; give a small number, such as 1e-5")
    (description,) = read_fmus([path])
    start = typed_values(path, description, start_pairs(path, values, description))
    worker = stack.enter_context(Worker(*MODULES))
    return ExchangeSource(worker, path, description, start, step)


def _complete(source: LinearizableSystem, selection: Selection) -> Selection:
    """Return the selected names, by default all.

    Raises:
        InputError: Every unknown name.
    """
    faults: list[Fault] = []
    for option, kind, chosen, names in (
        ("states", "state", selection.states, source.states),
        ("inputs", "input", selection.inputs, source.inputs),
        ("outputs", "output", selection.outputs, source.outputs),
        ("residualize", "state", selection.fast, source.states),
    ):
        faults += [Fault(Path(f"--{option}"), 0, 0, text) for text in _name_faults(source.title, kind, chosen, names)]
    both = [
        f"{n} is also selected by --states; name it in one of the two" for n in selection.fast if n in selection.states
    ]
    faults += [Fault(Path("--residualize"), 0, 0, text) for text in both]
    refuse(faults)
    states = selection.states or [n for n in source.states if n not in selection.fast]
    return Selection(states, selection.inputs or source.inputs, selection.outputs or source.outputs, selection.fast)


def _name_faults(model: str, kind: str, chosen: Sequence[str], names: Sequence[str]) -> Iterator[str]:
    for name, count in Counter(chosen).items():
        if name not in names:
            yield f'{model} has no {kind} "{name}"{did_you_mean(name, names)}'
        if count > 1:
            yield f"{name} is named twice; name it once"


def _linear(
    source: LinearizableSystem, points: Sequence[Point], selection: Selection, side: str | None
) -> list[Linear]:
    """Return the reduced linear model at every point."""
    try:
        whole = source.linear([settle(source, point, selection.fast) for point in points])
        if side is None:
            _check_smooth(whole, selection)
            whole = [replace(each, kinks=()) for each in whole]
        else:
            whole = _one_sided(source, whole, selection, SIDES[side])
        reduced = [residualize_states(each, selection.fast) for each in whole]
    except ValueError as error:
        raise InputError.at(Path("--residualize"), str(error)) from None
    if names := dict.fromkeys(n for each in reduced for n in missing_states(each, selection.states)):
        raise InputError.at(
            Path("--states"),
            (
                f"the selected states depend on {', '.join(names)}; add them, or, if they settle at once, name them "
                "as --residualize"
            ),
        )
    return [select(each, selection.states, selection.inputs, selection.outputs) for each in reduced]


def _check_smooth(linear: Sequence[Linear], selection: Selection) -> None:
    """Check that no selected signal has a kink.

    Raises:
        InputError: Every kink.
    """
    kinks = dict.fromkeys(kink for each in linear for kink in _kinks(each, selection))
    refuse(
        Fault(
            AT,
            0,
            0,
            (
                f"{kink.description}; there is no derivative: choose --side below or --side above, or give a point "
                "next to it"
            ),
        )
        for kink in kinks
    )


def _one_sided(source: LinearizableSystem, linear: Sequence[Linear], selection: Selection, sign: float) -> list[Linear]:
    """Return models with one-sided slopes at kinks.

    The point leaves one kink after another, inputs first, so that all slopes belong to the same branch. A kink between
    two variables is then passed by the first move. The slopes are returned for the point itself, except after a jump.

    Args:
        sign: Sign of the side.
    """
    moved = list(linear)
    for _ in range(len(source.states) + len(source.inputs)):
        remaining = [(i, kinks[-1].variable) for i, each in enumerate(moved) if (kinks := _kinks(each, selection))]
        if not remaining:
            break
        points = [_move_off(source, moved[i].point, name, sign) for i, name in remaining]
        for (i, _), each in zip(remaining, source.linear(points), strict=True):
            moved[i] = each
    models = []
    for at, off in zip(linear, moved, strict=True):
        sides = tuple(kink.choose_side(_slopes(off, kink)) for kink in _kinks(at, selection))
        if not any(row.jump for kink in at.kinks for row in kink.rows):
            off = replace(off, point=at.point, rates=at.rates, values=at.values)
        models.append(replace(off, kinks=sides))
    return models


def _slopes(linear: Linear, kink: Kink) -> dict[tuple[str, str], float]:
    """Return the slopes of all rates and outputs by a kink's variable."""
    if kink.variable in linear.inputs:
        slopes = np.vstack([linear.B, linear.D])[:, linear.inputs.index(kink.variable)]
    else:
        slopes = np.vstack([linear.A, linear.C])[:, linear.states.index(kink.variable)]
    rows = [*((RATE, n) for n in linear.states), *((OUTPUT, n) for n in linear.outputs)]
    return dict(zip(rows, slopes.tolist(), strict=True))


def _kinks(linear: Linear, selection: Selection) -> list[Kink]:
    """Return the kinks of selected signals."""
    states = (*selection.states, *selection.fast)
    variables = (*states, *selection.inputs)
    kinks = [k.restrict(states, selection.outputs) for k in linear.kinks if k.variable in variables]
    return [k for k in kinks if k.rows]


def _move_off(source: LinearizableSystem, point: Point, name: str, sign: float) -> Point:
    """Return the point with one signal moved by a few difference steps.

    Args:
        name: State or input to move.
        sign: Direction, 1 or −1.
    """

    group = "states" if name in source.states else "inputs"
    values, k = getattr(point, group).copy(), getattr(source, group).index(name)
    values[k] += sign * STEPS_OFF_KINK * source.reach * max(1.0, abs(values[k]))
    return replace(point, **{group: values})
