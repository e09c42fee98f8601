"""`design:` of a scenario: start values of a controller designed before the run, cached by content.

The designer (`cosim.model.design`), found through the registry, declares its options and objections.
"""

from __future__ import annotations

import json
import math
from collections.abc import Container, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Optional

from pydantic import AfterValidator, ConfigDict, Field, create_model

from cosim.base.errors import Crashed, Fault, FmuError, InputError, NotExecuted
from cosim.base.messages import Message, code_of, with_prefix
from cosim.base.registry import BASE, entry_of, model_entry, resolve
from cosim.base.version import __version__
from cosim.blocks.description import read_description
from cosim.fmi.sampled import law_of
from cosim.isolation.process import Worker
from cosim.loading.file import load_model, without_execution
from cosim.loading.refined import NoNearest, refined_file
from cosim.model.design import Designer, Judged, Objection, Option, Undesigned
from cosim.model.model import Model
from cosim.scenario.scenario import Design
from cosim.scenario.scenario_file import ScenarioFile
from cosim.scenario.start_values import convert_value
from cosim.storage.cache import load_or_make
from cosim.storage.yaml_file import NotNegative, Positive, short


def _complex(value: Any) -> Any:
    """Return a number, or a complex number as text; raise ValueError for other values."""
    try:
        number = complex(value.replace(" ", "").replace("i", "j") if isinstance(value, str) else value)
    except (TypeError, ValueError):
        number = complex("nan")
    if isinstance(value, bool) or not (math.isfinite(number.real) and math.isfinite(number.imag)):
        raise ValueError(f"{value!r} is no number; write -4 or, complex, -4+1j")
    return str(number).strip("()") if number.imag else number.real


MAX_DIFFERENCE = 1e-6  # relative difference of numbers treated as equal, e.g. typed and calculated
Complex = Annotated[Any, AfterValidator(_complex)]


class _Options(Design):
    """The options of a designer, without further keys."""

    model_config = ConfigDict(extra="forbid")


def designed_values(file: ScenarioFile) -> dict[str, dict[str, Any]]:
    """Design the controller; return its start values by component.

    The scenario gets the options with their defaults. Failures and warnings are added to the file's.
    """
    design = file.scenario.design
    if design is None:
        return {}
    try:
        model, designer = _read_design(file, design)
        law = _law(file, design.component)
        options = _options(file, design, designer, law)
        own = getattr(file.scenario.components.get(design.component), "start", None) or {}
        faults = [_fault(file, o, own, design.component) for o in designer.objections(options, law)]
        faults += _contradictions(file, design.component, designer.collect_start_values(options, law), own)
        if file.faults or faults:  # A faulty scenario is never run.
            raise InputError(faults)
        source = _Design(file, designer, options, model, law)
        values = {**source.values(), **designer.collect_start_values(options, law)}
        verdict = source.verdict(values, own)
        if verdict.objections:
            raise InputError([_fault(file, o, own, design.component) for o in verdict.objections])
    except Undesigned as error:
        file.faults.append(_fault(file, error.objection, own, design.component))
        return {}
    except InputError as error:
        file.faults += error.faults
        return {}
    file.warnings += [*verdict.warnings, *_two_numbers(file, design.component, designer.rests_on(values, law))]
    return {design.component: values}


def designed_apart(file: ScenarioFile, worker: Worker | None) -> dict[str, dict[str, Any]]:
    """Return `designed_values`, with foreign Python executed in the worker.

    Without a worker, the model's Python is executed in this process.

    Raises:
        InputError: The Python file ends the worker.
    """
    if worker is None:
        return designed_values(file)
    try:
        with without_execution():
            return designed_values(file)
    except NotExecuted as code:
        try:
            values, design, file.faults, file.warnings = worker.call(_design_of, file)
        except Crashed as crash:
            raise InputError([crash_fault(code.file, crash)]) from None
        if design is not None:
            file.scenario = file.scenario.model_copy(update={"design": Design.model_validate(design)})
        return dict(values)


def crash_fault(file: Path, crash: Crashed) -> Fault:
    """Return the fault of a Python file that ended the worker."""
    reason = crash.reason.replace("the worker", "its Python", 1)
    return Fault(file, 0, 0, f"does not load: {reason}")


def _design_of(file: ScenarioFile) -> tuple[Any, Any, list[Fault], list[str]]:
    """Return designed values, design, faults and warnings from a worker."""
    values, design = designed_values(file), file.scenario.design
    return values, None if design is None else design.model_dump(), file.faults, file.warnings


def _fault(file: ScenarioFile, objection: Objection, own: Mapping[str, Any], component: str) -> Fault:
    """Return the fault of an objection.

    Its place is the start value concerned, if the scenario sets one; otherwise the option.
    """
    start = next((name for name in objection.values if name in own), None)
    if start is not None:
        return file.fault(("components", component, "start", start), objection.message)
    option = next(iter(objection.about), None)
    section = file.yaml.root.get("design")
    text = with_prefix(f"{'design' if option is None else option}: ", objection.message)
    if not isinstance(section, dict) or option not in section:  # a default, or from outside the file
        return file.yaml.fault(("design",), text, key=True)
    return file.fault(("design", *objection.about), text)


def _contradictions(
    file: ScenarioFile, component: str, options: Mapping[str, Any], own: Mapping[str, Any]
) -> list[Fault]:
    """Return a fault for each design option that contradicts a start value of the component."""
    faults = []
    for name, value in options.items():
        if isinstance(value, str) and name in own and own[name] != value:
            message = f"{name} is {short(own[name])} here and {short(value)} in design: leave one of them out"
            faults.append(file.fault(("components", component, "start", name), message))
    return faults


def _read_design(file: ScenarioFile, design: Design) -> tuple[Model | None, Designer]:
    """Return the model named by the design (None without a name), and the designer of its controller."""
    if design.model is None and design.nearest:
        raise InputError([file.fault(("design", "nearest"), "nearest is of a refine; name its folder as model")])
    if design.model is None:
        return None, resolve(model_entry().design)
    where = ("design", "model")
    try:
        path = refined_file(file.path.parent / design.model, nearest=bool(design.nearest))
        model = load_model(BASE if design.model == BASE else str(path), Path()).model
    except NoNearest as error:
        raise InputError([file.fault(("design", "nearest"), str(error))]) from None
    except InputError as error:  # Faults without a line are reported at the key that names the file.
        prefix = f"model: {design.model}: "
        faults = [f if f.line else file.fault(where, with_prefix(prefix, f.message), f.exit_code) for f in error.faults]
        raise InputError(faults) from None
    entry = entry_of(type(model))
    if entry is None or not entry.design:
        raise InputError([file.fault(where, f"{design.model} is {model.title}; no controller is designed for it here")])
    return model, resolve(entry.design)


def _law(file: ScenarioFile, component: str) -> str:
    """Return the control law of the designed FMU, or ""."""
    fmu = getattr(file.scenario.components.get(component), "fmu", None)
    return "" if fmu is None else law_of(file.resolve(fmu))


def _options(file: ScenarioFile, design: Design, designer: Designer, law: str) -> dict[str, Any]:
    """Return the design's valid options; raise InputError with all faults."""
    fields: dict[str, Any] = {n: (_kind(option), _default(option, law)) for n, option in designer.options.items()}
    model = create_model("Design", __base__=_Options, **fields)
    options = file.yaml.validate(model, design.model_dump(), ("design",))
    file.scenario = file.scenario.model_copy(update={"design": options})
    return {name: getattr(options, name) for name in designer.options}


def _default(option: Option, law: str) -> Any:
    if option.laws and law not in option.laws:
        return None
    return list(option.default) if isinstance(option.default, tuple) else option.default


def _kind(option: Option) -> Any:
    """Return the type of an option's values."""
    if option.choices:
        return Optional[Literal[option.choices]]  # noqa: UP045 - made at run time
    number: Any = Complex if option.complex else Positive if option.positive else NotNegative
    if option.length is None:
        return Optional[number]  # noqa: UP045
    several: Any = Annotated[list[number], Field(min_length=option.length, max_length=option.length)]
    return Optional[several] if option.laws else several  # noqa: UP045


def _two_numbers(file: ScenarioFile, component: str, numbers: Mapping[str, float]) -> list[str]:
    """Return a warning for each number with two values.

    The component's start values and the design may differ.
    """
    own = _numbers(file, component, numbers)
    return [
        (
            f"{name} is {own[name]:g} in components.{component}.start and {value:g} in design: it runs with the "
            "first and is designed with the second"
        )
        for name, value in numbers.items()
        if name in own and not math.isclose(own[name], value, rel_tol=MAX_DIFFERENCE)
    ]


def _numbers(file: ScenarioFile, component: str, names: Container[str]) -> dict[str, float]:
    """Return named start values of a component as numbers.

    They have the units of their variables.
    """
    part = file.scenario.components.get(component)
    values = {name: value for name, value in (getattr(part, "start", None) or {}).items() if name in names}
    if any(isinstance(value, str) for value in values.values()):
        try:
            description = read_description(file.resolve(getattr(part, "fmu", "")))
        except FmuError:  # Another check reports the unreadable FMU at its key.
            return {}
        variables = {v.name: v for v in description.modelVariables}
        values = {n: convert_value(description, variables[n], v) for n, v in values.items() if n in variables}
    return {n: v for n, v in values.items() if isinstance(v, (int, float)) and not isinstance(v, bool)}


@dataclass(frozen=True)
class _Design:
    """A design with results cached in the user's cache folder."""

    file: ScenarioFile
    designer: Designer
    options: Mapping[str, Any]
    model: Model | None
    law: str

    def values(self) -> dict[str, float]:
        """Return the designed values; raise InputError if none exist."""
        try:
            key = self._key(model=self.designer.depends_on(self.model))
            values = load_or_make(key, lambda: self.designer.values(self.options, self.model, self.law))
        except Undesigned:
            raise
        except ValueError as error:
            raise InputError([self.file.yaml.fault(("design",), f"design: {error}", key=True)]) from None
        return {name: float(value) for name, value in values.items()}

    def verdict(self, values: Mapping[str, Any], own: Mapping[str, Any]) -> Judged:
        """Validate design values after the component's start values have been applied."""

        def judge() -> dict[str, Any]:
            verdict = self.designer.judged(values, dict(own), self.options, self.law)
            return {
                "objections": [(o.about, o.message, code_of(o.message), o.values) for o in verdict.objections],
                "warnings": [(text, code_of(text)) for text in verdict.warnings],
            }

        record = load_or_make(self._key(values=values, own=dict(own)), judge)
        objections = [Objection(tuple(a), Message(text, code), tuple(n)) for a, text, code, n in record["objections"]]
        return Judged(objections, [Message(text, code) for text, code in record["warnings"]])

    def _key(self, **content: Any) -> str:
        """Return the key of a result in the cache."""
        designer = {"format": self.designer.version, "designer": type(self.designer).__qualname__}
        key = {"version": __version__, **designer, "options": self.options, "law": self.law, **content}
        return json.dumps(key, sort_keys=True)
