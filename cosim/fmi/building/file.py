"""Model files: a model with its parameter values and sensor errors. `cosim refine` writes them; studies name them."""

from __future__ import annotations

import linecache
import os.path
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from pydantic import Field, ValidationError, ValidatorFunctionWrapHandler, WrapValidator

from cosim.core.errors import Fault, InputError, NotExecuted, refuse
from cosim.core.registry import BASE, MODELS_GROUP, is_model, model_entry, resolve
from cosim.core.registry import names as registered_names
from cosim.core.text import did_you_mean
from cosim.files.artefact import CODE, MODEL, kind_by_keys, skipped_files
from cosim.files.files import write_text
from cosim.files.kinds import check_form, refuse_other
from cosim.files.yaml_file import UNIT_OF_KEY, Amount, Number, Part, Positive, YamlFile
from cosim.fmi.building.declared import ModelText, make_model
from cosim.fmi.building.refined import refined_file
from cosim.model.model import Model
from cosim.terms.language import Term

if TYPE_CHECKING:
    from cosim.fmi.fmu_build import Recipe

K = TypeVar("K")
SUBCLASS = "a model must be a subclass of cosim.model.Model"


def _number_or_switch(value: Any, inner: ValidatorFunctionWrapHandler) -> Any:
    """Return a number or a Boolean; all type errors give the same message."""
    try:
        return inner(value)
    except ValidationError:
        cure = "give a finite number, or text with a unit such as 400 g; for a Boolean, true or false"
        raise ValueError(cure) from None


Value = Annotated[Number | bool, WrapValidator(_number_or_switch), UNIT_OF_KEY]


class Identified(Part):
    """Accuracy of an identified parameter.

    ci95:   its 95 % confidence interval
    unit:   of the interval
    origin: the test that identified it
    """

    ci95: tuple[float, float]
    unit: str = ""
    origin: str = ""


class ModelFile(Part):
    """Model name, parameters by FMI name, and sensor errors.

    schema_version:  version of the file format
    model:           a registered name, or `file.py:Class` of a user's model
    parameters_from: another model file, or a refine's folder, with values for common parameters
    parameters:      name → value, in the unit of the parameter or text such as `400 g`; overrides `parameters_from`
    sensors:         sensor error → value
    substep:         longest substep of the integration [s], unless the model's class states one
    integrator:      rk4, or stiff: the implicit method for stiff equations; by default the class's
    identified:      parameter → accuracy, as written by `cosim identify`
    """

    schema_version: Literal[1] = 1
    model: str = BASE
    parameters_from: str = ""
    parameters: dict[str, Value] = Field(default_factory=dict)
    sensors: dict[str, Amount] = Field(default_factory=dict)
    substep: Positive | None = None
    integrator: Literal["rk4", "stiff"] | None = None
    identified: dict[str, Identified] = Field(default_factory=dict)


@dataclass(frozen=True)
class LoadedModel:
    """A model with its effects, sensor errors and source file."""

    model: Model
    source: str
    parameters: Mapping[str, float | bool] = field(default_factory=dict)
    sensors: Mapping[str, float] = field(default_factory=dict)

    @property
    def values(self) -> dict[str, float]:
        """Return all sensor errors by name, including zeros."""
        clean = {name: float(p.default) for name, p in self.model.sensor_parameters.items()}
        return {**clean, **self.sensors}

    def recipe(self) -> Recipe:
        """Return the recipe (`Recipe`) from which the model's FMU is built."""
        from cosim.fmi.fmu_build import model_recipe

        if is_model(self.source):
            recipe: Recipe = resolve(model_entry(self.source).recipe)(dict(self.parameters))
            return replace(recipe, substep=self.model.chosen_substep, integrator=self.model.chosen_integrator)
        return model_recipe(self.model, Path(self.source.rpartition(":")[0]), dict(self.parameters))


def named_model(name: str) -> Model:
    """Return a registered model with default parameters."""
    model: Model = resolve(model_entry(name).model)()
    return model


def load_model(text: str, folder: Path, named_in: YamlFile | None = None) -> LoadedModel:
    """Load a model named in a command or study.

    Args:
        text: Registered name, path of a model.yaml, or `file.py:Class`.
        folder: Folder to which relative paths refer.
        named_in: Study that names the model; a missing file is a fault of its key `model`.

    Raises:
        InputError: The model has faults, all of which the error names.
    """

    def refusal(file: Path, message: str) -> InputError:
        return InputError([named_in.fault(("model",), message) if named_in else Fault(file, 0, 0, message)])

    if is_model(text):
        return LoadedModel(named_model(text), model_entry(text).name)
    file, own, _ = text.rpartition(":") if ".py:" in text else (text, "", "")
    path, registered = folder / file, registered_names(MODELS_GROUP)
    allowed = f"allowed: {', '.join(registered)}, a model.yaml, or FILE.py:Class of your own model"
    if not path.exists() or (named_in and not path.is_file()):
        raise refusal(path, f'no model "{text}"{did_you_mean(text, registered)}; {allowed}')
    if own:
        return LoadedModel(own_model(text, folder), f"{path.resolve()}:{text.rpartition(':')[2]}")
    if path.suffix == ".py":
        raise refusal(path, f"names no class: write {text}:{(ModelText(path).classes or ['Class'])[-1]}; {allowed}")
    return read_model(path)


def read_model(path: Path, readers: tuple[Path, ...] = ()) -> LoadedModel:
    """Read a model.yaml and check its names and bounds.

    Args:
        readers: Chain of files whose `parameters_from` leads to this file, to detect circles.
    """
    check_form(path, MODEL, CODE)
    yaml = YamlFile(path)
    kind = kind_by_keys(yaml.root)
    refuse_other(path, kind, MODEL)
    content, faults = yaml.partly(ModelFile, "model")
    try:
        if (path.parent / content.model).is_file():
            reason = f"{content.model} is a file; name a registered model or FILE.py:Class"
            raise InputError([yaml.fault(("model",), reason)])
        base = load_model(content.model, path.parent, yaml)
    except InputError as error:
        raise InputError([*faults, *error.faults]) from None
    except NotExecuted:
        refuse(faults)
        raise
    model = base.model
    for section, declared in (("parameters", model.declared), ("sensors", model.sensor_parameters)):
        units, is_sensor = {n: p.unit for n, p in declared.items()}, section == "sensors"
        content, wrong = yaml.in_units(content, section, units, difference=is_sensor)
        faults += wrong
        for name, value in getattr(content, section).items():
            if name not in declared:
                unknown = f'{content.model} has no {section[:-1]} "{name}"{did_you_mean(name, declared)}'
                faults.append(yaml.fault((section, name), unknown, key=True))
            elif text := declared[name].fault(value):
                effect, dot, _ = name.rpartition(".")
                faults.append(yaml.fault((section, name), f"{effect}{dot}{text}; correct the value"))
    values: dict[str, float | bool] = {}
    # A parameter file of a smaller model, e.g. of a part refined on a test rig, may serve a larger model.
    if name := content.parameters_from:
        other, here, reasons = refined_file(path.parent / name), (*readers, path.resolve()), []
        if not other.is_file() or other.resolve() in here:
            reasons = [f"{name} is no other model file; give a model.yaml or the folder of a refine"]
        else:
            try:
                values = {n: v for n, v in read_model(other, here).parameters.items() if n in model.declared}
                texts = (fault for n, v in values.items() if (fault := model.declared[n].fault(v)))
                reasons = [f"{name}: {text}; correct it there, or write it under parameters" for text in texts]
                if not values:
                    reasons = [f"{name} has no parameter in common with {model.title}; remove it"]
            except InputError as error:
                faults += error.faults
        faults += [yaml.fault(("parameters_from",), reason) for reason in reasons]
    refuse(faults)
    values |= content.parameters
    model = model.with_values(values).with_substep(content.substep, content.integrator)
    return LoadedModel(model, base.source, values, content.sensors)


def own_model(text: str, folder: Path) -> Model:
    """Return the model `Class` of `file.py`; raise InputError with all faults."""
    file, _, name = text.rpartition(":")
    source, module = _execute((folder / file).resolve())
    kinds = _classes(module, Model)
    if name not in kinds:
        classes = f" (models here: {', '.join(kinds)})" if kinds else ""
        message = f'has no model class "{name}"{did_you_mean(name, kinds)}{classes}; {SUBCLASS}'
        raise InputError.at(source.path, message)
    return make_model(kinds[name], source)


def only_model(path: Path) -> Model:
    """Return the only model of `file.py`. Raise InputError for faults, and unless the file has exactly one model."""
    source, module = _execute(path.resolve())
    own = {kind: name for name, kind in reversed(_classes(module, Model).items()) if kind.__module__ == module.__name__}
    if len(own) != 1:  # of the classes defined in the file, not imported ones; a class with two names counts once
        choice = " or ".join(f"{path}:{name}" for name in reversed(own.values()))
        raise InputError.at(
            path, f"has {len(own)} models; write {choice}" if own else f"has no model class; {SUBCLASS}"
        )
    return make_model(next(iter(own)), source)


def own_terms(path: Path) -> list[type[Term]]:
    """Return the terms of a user's file: classes derived from `cosim.terms.Term`.

    Raises:
        InputError: The file has faults, or no terms.
    """
    _, module = _execute(path.resolve())
    own = [v for v in _classes(module, Term).values() if v.__module__ == module.__name__]
    if not own:
        reason = "has no term; write a subclass of cosim.terms.Force, InputTerm or RateTerm with a `kind`"
        raise InputError.at(path, reason)
    return own


def _execute(path: Path) -> tuple[ModelText, ModuleType]:
    """Execute a file; return its text and module.

    This is the only place that executes a model's Python.

    Raises:
        InputError: The file does not exist, raises an exception or is not Python.
        NotExecuted: Execution is disabled by `without_execution`.
    """
    if not path.is_file():
        raise InputError.at(path, "no such model file; check the path")
    source, name = ModelText(path), f"own_model_{path.stem}"
    try:
        code = compile(path.read_bytes(), str(path), "exec", dont_inherit=True)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise InputError([source.convert_error(error, "does not load")]) from None
    if (skipped := skipped_files.get()) is not None:
        skipped.append(path)
        raise NotExecuted(path)
    module = ModuleType(name)
    module.__file__ = str(path)
    sys.modules[name] = module  # dataclasses resolve annotations in sys.modules
    linecache.checkcache(str(path))
    try:
        exec(code, vars(module))
    except (Exception, SystemExit) as error:  # A user's file may raise any error.
        raise InputError([source.convert_error(error, "does not load")]) from error
    return source, module


def _classes(module: ModuleType, base: type[K]) -> dict[str, type[K]]:
    """Return the classes in a module that derive from a base class, by name."""
    return {n: v for n, v in vars(module).items() if isinstance(v, type) and issubclass(v, base) and v is not base}


def write_model(path: Path, loaded: LoadedModel, folder: Path | None = None) -> None:
    """Write a model.yaml that `read_model` reads.

    Args:
        folder: Folder to which the file will be moved, if any.
    """
    source, within = loaded.source, (folder or path.parent).resolve()
    file, _, name = source.rpartition(":")
    if file and within.is_relative_to(Path(file).parent):  # Relative, so that both files can be moved together.
        source = f"{Path(os.path.relpath(file, within)).as_posix()}:{name}"
    lines = ["schema_version: 1", f"model: {source}"]
    if loaded.model.chosen_substep is not None:
        lines.append(f"substep: {loaded.model.chosen_substep!r}")
    if loaded.model.chosen_integrator is not None:
        lines.append(f"integrator: {loaded.model.chosen_integrator}")
    for section, values in (("parameters", loaded.parameters), ("sensors", loaded.sensors)):
        lines.append(f"{section}:" if values else f"{section}: {{}}")
        lines += [
            f"  {name}: {str(v).lower() if isinstance(v, bool) else repr(float(v))}" for name, v in values.items()
        ]
    write_text(path, "\n".join(lines) + "\n")
