"""Workflow of a linearization: model or FMU → point → derivatives → reduction → linear.json, .mat, .py, page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cosim.authoring.single import start_pairs
from cosim.base.arrays import Array
from cosim.base.errors import Fault, InputError, refuse
from cosim.base.registry import BASE, is_model
from cosim.base.settings import Given, Positive, texts
from cosim.blocks.compiling import compiling
from cosim.linearization.along import Along
from cosim.linearization.fmu_source import MODULES, ExchangeSource, typed_values
from cosim.linearization.kinks import BESIDE, OUTPUT, RATE, SIDES, Kink
from cosim.linearization.linear_model import Linear, Point, chosen, missing_states, residualised
from cosim.linearization.linear_sources import EquationSource, Source, settled
from cosim.linearization.point import AT, moved, read_at
from cosim.linearization.result import Outcome
from cosim.linearization.set_parameters import with_parameters
from cosim.linearization.system_structure import structure
from cosim.linearization.write import FILES, write
from cosim.loading.file import LoadedModel, load_model, named_model
from cosim.loading.refined import names_refine, refined_file
from cosim.storage.files import FilePath, check_writable, named_path, write_text
from cosim.storage.folder_lock import folder_locks
from cosim.storage.folders import check_left, keep_earlier
from cosim.storage.kinds import CODE, FMU, MODEL, check_given, kind_of
from cosim.storage.yaml_file import did_you_mean

SIDE = Path("--side")
NO_DERIVATIVE = "; there is no derivative: say --side below or --side above, or give a point beside it"
MOST_TOLD = 10  # kinks
IDLE = "moves nothing at this point: a dead band or a stop, perhaps"


@dataclass(frozen=True)
class Asked:
    """Selection of a linear model's signals; empty for all.

    Attributes:
        fast: States to eliminate at their steady state.
    """

    states: Sequence[str] = ()
    inputs: Sequence[str] = ()
    outputs: Sequence[str] = ()
    fast: Sequence[str] = ()


@folder_locks()
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
    force: bool = True,
    keep: bool = False,
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
        force: Overwrite results of another model or command in `out`.
        keep: Move the files of an earlier call to `runs`.
        compile: Compile and execute the sources of an FMU that has no library for this machine.

    Returns:
        The linear models, their structure and notes.

    Raises:
        InputError: Every fault of the input.
        FmuError: An FMU cannot be read or loaded.
        SimulationError: The simulation failed.
    """
    if side is not None and side not in SIDES:
        raise InputError([Fault(SIDE, 0, 0, f"is below or above{did_you_mean(side, tuple(SIDES))}")])
    given_values = texts(set)
    where, folder = read_at(texts(at, "at")), None if out is None else named_path(out)
    asked = Asked(states, inputs, outputs, residualize)
    with ExitStack() as stack:
        stack.enter_context(compiling(compile))
        source = _source(stack, Path(model), given_values, step)
        asked = _checked(source, asked)
        if folder is not None:
            check_left(folder, "cosim linearize", str(model), force=force, keep=keep)
            check_writable(folder, (*FILES, "report.html"), source.files)
        notes: list[str] = []
        if where.moment is None:
            points = [source.start()]
        else:
            along = Along(source, where.moment, component)
            source = source.with_values(along.start_values, given_values)
            points, notes = along.points(source), along.notes
        points = [moved(source, point, where.values) for point in points]
        found = _linear(source, points, asked, side)
    notes += _notes(found, notes)
    if side is not None and not any(each.kinks for each in found):
        notes.append(f"--side {side} changes nothing: slopes of what is kept are the same on both sides here")
    outcome = Outcome(str(model), source.title, tuple(found), structure(found[0]), tuple(notes), folder)
    if folder is not None:
        if keep:
            keep_earlier(folder, "cosim linearize")
        write(folder, outcome.name, outcome.title, outcome.linear, outcome.structure, outcome.notes)
        if report:
            from cosim.linearization.report import page

            write_text(folder / "report.html", page(outcome))
    return outcome


def _notes(found: Sequence[Linear], known: Sequence[str]) -> list[str]:
    """Return further notes: idle inputs, slopes at kinks, notes of the models."""
    idle = [f"{name} {IDLE}" for name in _idle(found)]
    beside = [f"{k.description}; the slopes here are those {k.side}" for each in found for k in each.kinks]
    more = [f"{len(beside) - MOST_TOLD} kinks more; linear.json has all"] if len(beside) > MOST_TOLD else []
    told = [*idle, *beside[:MOST_TOLD], *more]
    own = dict.fromkeys(n for each in found for n in each.notes) if found[0].notes else ()
    return [*told, *(n for n in own if n not in (*known, *told))]


def _idle(found: Sequence[Linear]) -> list[str]:
    """Return inputs without any effect at all points."""
    sizes = [np.abs(np.vstack([m.B, m.D])).max(axis=0, initial=0.0) for m in found]
    return [n for n, size in zip(found[0].inputs, np.max(sizes, axis=0).tolist(), strict=True) if size == 0.0]


def _source(stack: ExitStack, path: Path, given: Sequence[str], step: float | None) -> Source:
    """Return the source for a model name or file."""
    text = str(path)
    if not is_model(text) and text != BASE and ".py:" not in text and not names_refine(path):
        if path.exists():
            check_given(path, MODEL, FMU, CODE)
        if kind_of(path) == FMU:
            return _fmu(stack, path, given, step)
    if step is not None:
        told = "is of FMUs; equations are differentiated exactly, so leave it out"
        raise InputError([Fault(Path("--step"), 0, 0, told)])
    if is_model(text):
        loaded = LoadedModel(named_model(text), text)
    else:
        loaded = load_model(str(refined_file(path) if names_refine(path) else text), Path())
    return EquationSource(replace(loaded, model=with_parameters(loaded.model, given)), text)


def _fmu(stack: ExitStack, path: Path, given: Sequence[str], step: float | None) -> Source:
    from cosim.blocks.summary import read_fmus
    from cosim.isolation.process import Worker

    if step is not None and not 0.0 < step < 1.0:
        raise InputError([Fault(Path("--step"), 0, 0, f"{step:g}: give a small number above 0, such as 1e-5")])
    (description,) = read_fmus([path])
    start = typed_values(path, description, start_pairs(path, given, description))
    worker = stack.enter_context(Worker(*MODULES))
    return ExchangeSource(worker, path, description, start, step)


def _checked(source: Source, asked: Asked) -> Asked:
    """Return the selected names, by default all.

    Raises:
        InputError: Every unknown name.
    """
    faults: list[Fault] = []
    for option, names, known in (
        ("states", asked.states, source.states),
        ("inputs", asked.inputs, source.inputs),
        ("outputs", asked.outputs, source.outputs),
        ("residualize", asked.fast, source.states),
    ):
        place = Path(f"--{option}")
        for name in names:
            if name not in known:
                told = f'{source.title} has no {option.removesuffix("s").replace("residualize", "state")} "{name}"'
                faults.append(Fault(place, 0, 0, told + did_you_mean(name, known)))
        faults += [Fault(place, 0, 0, f"{n} is named twice") for n, count in Counter(names).items() if count > 1]
    for name in asked.fast:
        if name in asked.states:
            told = f"{name} is to be kept by --states too; name it in one of them"
            faults.append(Fault(Path("--residualize"), 0, 0, told))
    refuse(faults)
    states = asked.states or [n for n in source.states if n not in asked.fast]
    return Asked(states, asked.inputs or source.inputs, asked.outputs or source.outputs, tuple(asked.fast))


def _linear(source: Source, points: Sequence[Point], asked: Asked, side: str | None) -> list[Linear]:
    """Return the reduced linear model at every point."""
    try:
        whole = source.linear([settled(source, point, asked.fast) for point in points])
        whole = _without_kinks(whole, asked) if side is None else _beside(source, whole, asked, SIDES[side])
        found = [residualised(each, asked.fast) for each in whole]
    except ValueError as error:
        raise InputError([Fault(Path("--residualize"), 0, 0, str(error))]) from None
    lacking = list(dict.fromkeys(n for each in found for n in missing_states(each, asked.states)))
    if lacking:
        cure = "add them, or, where they settle at once, name them as --residualize"
        told = f"what is kept depends on {', '.join(lacking)}; {cure}"
        raise InputError([Fault(Path("--states"), 0, 0, told)])
    return [chosen(each, asked.states, asked.inputs, asked.outputs) for each in found]


def _without_kinks(found: Sequence[Linear], asked: Asked) -> list[Linear]:
    """Return models without kinks.

    Raises:
        InputError: A selected signal has a kink.
    """
    kinks = dict.fromkeys(kink for each in found for kink in _kinks(each, asked))
    if kinks:
        raise InputError([Fault(AT, 0, 0, kink.description + NO_DERIVATIVE) for kink in kinks])
    return [replace(each, kinks=()) for each in found]


def _beside(source: Source, found: Sequence[Linear], asked: Asked, sign: float) -> list[Linear]:
    """Return models with one-sided slopes at kinks.

    The point leaves one kink after another, inputs first, so that all slopes belong to the same branch. A kink between
    two variables is then passed by the first move.

    Args:
        sign: Sign of the side.
    """
    made = list(found)
    for _ in range(len(source.states) + len(source.inputs)):
        left = [(i, kinks[-1].variable) for i, each in enumerate(made) if (kinks := _kinks(each, asked))]
        if not left:
            break
        points = [_moved(source, made[i].point, name, sign) for i, name in left]
        for (i, _), each in zip(left, source.linear(points), strict=True):
            made[i] = each
    return [
        replace(
            _put_back(at, beside), kinks=tuple(kink.choose_side(_slopes(beside, kink)) for kink in _kinks(at, asked))
        )
        for at, beside in zip(found, made, strict=True)
    ]


def _put_back(at: Linear, beside: Linear) -> Linear:
    """Return one-sided slopes at the point itself, or beside the point after a jump."""
    if any(row.jump for kink in at.kinks for row in kink.rows):
        return beside
    return replace(beside, point=at.point, rates=at.rates, values=at.values)


def _slopes(linear: Linear, kink: Kink) -> dict[tuple[str, str], float]:
    """Return the slopes of all rates and outputs by a kink's variable."""
    to_rates, to_outputs, names = (linear.A, linear.C, linear.states)
    if kink.variable in linear.inputs:
        to_rates, to_outputs, names = (linear.B, linear.D, linear.inputs)
    k = names.index(kink.variable)
    rates = {(RATE, n): float(v) for n, v in zip(linear.states, to_rates[:, k], strict=True)}
    return rates | {(OUTPUT, n): float(v) for n, v in zip(linear.outputs, to_outputs[:, k], strict=True)}


def _kinks(linear: Linear, asked: Asked) -> list[Kink]:
    """Return the kinks of selected signals."""
    states = (*asked.states, *asked.fast)
    kept = [k.restrict(states, asked.outputs) for k in linear.kinks if k.variable in (*states, *asked.inputs)]
    return [k for k in kept if k.rows]


def _moved(source: Source, point: Point, name: str, sign: float) -> Point:
    """Return a point a few difference steps to one side."""

    def beside(names: Sequence[str], values: Array) -> Array:
        off = BESIDE * source.reach * np.maximum(1.0, np.abs(values))
        return np.where([n == name for n in names], values + sign * off, values)

    if name in source.states:
        return replace(point, states=beside(source.states, point.states))
    return replace(point, inputs=beside(source.inputs, point.inputs))
