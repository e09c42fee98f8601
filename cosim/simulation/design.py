"""`design:` of a scenario: start values of a controller designed before the run, cached by content.

What can be designed, and what may be said of it, the designer declares (`plant.design`); the registry knows it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Optional

from pydantic import AfterValidator, ConfigDict, Field, create_model

from cosim.errors import Fault, InputError
from cosim.files import atomic_write
from cosim.models.file import load_model
from cosim.models.refined import NoNearest, refined_file
from cosim.registry import BASE, BASE_NAME, MODELS, known, resolve
from cosim.simulation.scenario import Design
from cosim.simulation.scenario_file import ScenarioFile
from cosim.yaml_file import NotNegative, Positive
from fmus.native.cache import cached
from fmus.sampled import law_of
from plant.design import BadOption, Designer, Option
from plant.model import Model


def _complex(value: Any) -> Any:
    """A number, or the text of a complex one, as it was written; ValueError where it is neither, or not finite."""
    try:
        number = complex(value.replace(" ", "").replace("i", "j") if isinstance(value, str) else value)
    except (TypeError, ValueError):
        number = complex("nan")
    if isinstance(value, bool) or not (math.isfinite(number.real) and math.isfinite(number.imag)):
        raise ValueError(f"{value!r} is no number; write -4 or, complex, -4+1j")
    return str(number).strip("()") if number.imag else number.real


Complex = Annotated[Any, AfterValidator(_complex)]


class _Declared(Design):
    """With the options of one designer, and no further keys."""

    model_config = ConfigDict(extra="forbid")


def designed_values(file: ScenarioFile) -> dict[str, dict[str, Any]]:
    """Start values by component that the design gives; its options are written into the scenario, defaults too.

    A design that fails is one more fault of the file.
    """
    design = file.scenario.design
    if design is None:
        return {}
    try:
        model, designer = _asked(file, design)
        law = _law(file, design.component)
        options = _options(file, design, designer, law)
        if file.faults:  # a faulty scenario is not run
            return {}
        values = _designed(file, designer, options, model, law)
    except InputError as error:
        file.faults += error.faults
        return {}
    designed = {**values, **designer.given(options)}
    _check_together(file, design.component, designer, designed, law)
    return {design.component: designed}


def _check_together(
    file: ScenarioFile, component: str, designer: Designer, designed: Mapping[str, Any], law: str
) -> None:
    """The scenario's own start values stand over what is designed: whether both go together."""
    own = getattr(file.scenario.components.get(component), "start", None) or {}
    numbers = {n: v for n, v in own.items() if isinstance(v, (int, float)) and not isinstance(v, bool)}
    place = ("design",) if designer.conflicts(designed, law) else ("components", component, "start")
    file.faults += [file.fault(place, said) for said in designer.conflicts({**designed, **numbers}, law)]


def _asked(file: ScenarioFile, design: Design) -> tuple[Model | None, Designer]:
    """The model of `design.model`, None where none is named, and who designs its controller."""
    if design.model is None and design.nearest:
        raise InputError([file.fault(("design", "nearest"), "nearest is of a refine; name its folder as model")])
    if design.model is None:
        return None, resolve(MODELS[BASE_NAME].design)
    try:
        named = refined_file(file.path.parent / design.model, nearest=bool(design.nearest))
    except NoNearest as error:
        raise InputError([file.fault(("design", "nearest"), str(error))]) from None
    loaded = load_model(BASE if design.model == BASE else str(named), Path())
    entry = known(type(loaded.model))
    if entry is None or not entry.design:
        message = f"{design.model} is {loaded.model.title}; no controller is designed for it here"
        raise InputError([file.fault(("design", "model"), message)])
    return loaded.model, resolve(entry.design)


def _law(file: ScenarioFile, component: str) -> str:
    """The control law of the FMU that is designed for; "" where it says none, or is none."""
    named = getattr(file.scenario.components.get(component), "fmu", None)
    return "" if named is None else law_of(file.resolve(named))


def _options(file: ScenarioFile, design: Design, designer: Designer, law: str) -> dict[str, Any]:
    """The options as the designer declares them; InputError with every fault."""
    fields: dict[str, Any] = {n: (_kind(option), _default(option, law)) for n, option in designer.options.items()}
    declared = create_model("Design", __base__=_Declared, **fields)
    whole = file.yaml.validate(declared, design.model_dump(), ("design",))
    file.scenario = file.scenario.model_copy(update={"design": whole})
    return {name: getattr(whole, name) for name in designer.options}


def _default(option: Option, law: str) -> Any:
    if option.laws and law not in option.laws:
        return None
    return list(option.default) if isinstance(option.default, tuple) else option.default


def _kind(option: Option) -> Any:
    """The type of an option's values."""
    if option.choices:
        return Optional[Literal[option.choices]]  # noqa: UP045 - made at run time
    number: Any = Complex if option.complex else Positive if option.positive else NotNegative
    if option.length is None:
        return Optional[number]  # noqa: UP045
    return Annotated[list[number], Field(min_length=option.length, max_length=option.length)]


def _designed(
    file: ScenarioFile, designer: Designer, options: Mapping[str, Any], model: Model | None, law: str
) -> dict[str, float]:
    """Designed values, from the cache or now; InputError where there is no such design."""
    from cosim.version import __version__

    try:
        content = {"options": options, "model": designer.depends_on(model), "law": law}
        key = {"version": __version__, "format": designer.version, "designer": type(designer).__qualname__, **content}
        kept = cached(json.dumps(key, sort_keys=True), ".json")
        try:
            values = json.loads(kept.read_text(encoding="utf-8"))
            if isinstance(values, dict) and values and all(type(v) is float for v in values.values()):
                return values
        except (OSError, ValueError):
            pass  # none there, or it is not one
        made = designer.values(options, model, law)
    except ValueError as error:
        raise InputError([_fault(file, error)]) from None
    try:
        with atomic_write(kept) as stream:
            json.dump(made, stream)
    except OSError:
        pass  # a cache that cannot be written only costs time
    return made


def _fault(file: ScenarioFile, error: ValueError) -> Fault:
    if isinstance(error, BadOption):
        return file.fault(("design", error.option), f"{error.option}: {error}")
    return file.fault(("design",), f"design: {error}")
