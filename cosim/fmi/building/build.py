"""FMUs of a model: the work of `cosim build`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from shutil import copyfile
from typing import TYPE_CHECKING, Any, TypeVar, cast

from cosim.core.drafts import draft_of
from cosim.core.errors import Fault, InputError, refuse
from cosim.core.registry import BASE, entry_of, is_model, model_entry, models, resolve
from cosim.core.scratch import temporary_folder
from cosim.core.settings import ModelName, Names
from cosim.core.text import did_you_mean
from cosim.files.files import FilePath, check_folder, named_path
from cosim.files.yaml_file import YamlFile
from cosim.fmi.building.declared import ModelText
from cosim.fmi.building.file import LoadedModel, load_model
from cosim.fmi.building.refined import refined_file
from cosim.fmi.building.substep import with_substep
from cosim.fmi.native.compiler import PLATFORMS, CompilerFailed, NoCompiler, commands
from cosim.fmi.ports import Value
from cosim.model.model import Model

if TYPE_CHECKING:
    from cosim.fmi.native.package import Native, NativeFmu

Made = TypeVar("Made")
PLANT_FMU = "plant.fmu"
SUFFIX = {2: "-native.fmu", 3: "-native-fmi3.fmu"}


def build(
    folder: FilePath = Path("build"),
    model: ModelName | None = None,
    *,
    nearest: bool = False,
    native: bool = False,
    fmi: int = 2,
    platforms: Names = (),
    design: FilePath | None = None,
    tell: Callable[[str], None] = lambda text: None,
) -> list[Path]:
    """Build the FMUs of a model.

    Args:
        folder: Folder for the FMUs.
        model: Registered model (with its controllers), model.yaml, FILE.py:Class, or a folder written by `cosim
            refine`.
        nearest: Use nearest.yaml of that folder instead of model.yaml.
        native: Build compiled FMUs, which need no Python.
        fmi: FMI version of native FMUs, 2 or 3.
        platforms: Platforms of native FMUs; none means this machine.
        design: YAML file with weights and numbers of a controller design, which sets the start values of the
            controllers.
        tell (in Python): Function called with each warning of the design.

    Returns:
        Paths of the FMUs.

    Raises:
        InputError: The input is wrong; the error names all faults.
    """
    from cosim.fmi.fmu_build import Recipe
    from cosim.fmi.fmu_build import build as build_fmu

    folder = named_path(folder)
    check_folder(folder)
    if native:
        natives = build_native(folder, model, nearest=nearest, fmi=fmi, platforms=platforms, design=design, tell=tell)
        return [fmu.path for fmu in natives]

    loaded, starts = designed_model(model, nearest, design, tell)
    entry = entry_of(type(loaded.model))
    if entry is not None and entry.built and model in (None, entry.name):
        recipes, places = {}, dict(entry.built)
    else:
        recipes, every = {PLANT_FMU: loaded.recipe()}, entry.beside if entry else {}
        places = {name: place for name, place in every.items() if name in starts or is_model(loaded.source)}
    for name, place in places.items():
        recipe: Recipe = resolve(place)()
        recipes[name] = recipe.with_starts(starts[name]) if name in starts else recipe
    _write(folder, {name: partial(build_fmu, recipe) for name, recipe in recipes.items()})
    return [folder / name for name in recipes]


def _write(folder: Path, makers: Mapping[str, Callable[[Path], Made]]) -> dict[str, Made]:
    """Write files by functions that each write to a given path; write no file if one function fails."""
    with temporary_folder("build") as drafts:
        made = {name: make(drafts / name) for name, make in makers.items()}
        for name in makers:
            with draft_of(folder / name) as target:
                copyfile(drafts / name, target)
    return made


def build_native(
    folder: FilePath,
    model: str | None = None,
    *,
    nearest: bool = False,
    fmi: int = 2,
    platforms: Sequence[str] = (),
    design: FilePath | None = None,
    tell: Callable[[str], None] = lambda text: None,
) -> list[NativeFmu]:
    """Build the native FMUs of a model in `folder`.

    Args:
        model: As in `build`.
        fmi: FMI version, 2 or 3.
        platforms: Platform names; by default this machine's.
        design, tell: As in `build`.

    Raises:
        InputError: The build is impossible; nothing is written.
    """
    folder = named_path(folder)
    check_folder(folder)
    known, unknown = f"(known: {', '.join(PLATFORMS)})", [name for name in platforms if name not in PLATFORMS]
    texts = [f'no platform "{name}"{did_you_mean(name, PLATFORMS)} {known}' for name in unknown]
    refuse(Fault(Path("--platforms"), 0, 0, text) for text in texts)
    if fmi not in SUFFIX:
        raise InputError.at(Path("--fmi"), f"is {fmi}; allowed: {' or '.join(map(str, SUFFIX))}")
    _check_compiler(platforms)
    loaded, starts = designed_model(model, nearest, design, tell)
    native_names = model_entry(loaded.source).native if is_model(loaded.source) else {}
    if starts and not any(f"{name}.fmu" in starts for name in native_names):
        raise InputError.at(
            Path("--design"), "this model has no controller with a native FMU; build it without --native"
        )
    makers = {
        f"{name}{SUFFIX[fmi]}": partial(_compile, native, fmi=fmi, platforms=platforms)
        for name, native in _natives(loaded, starts)
    }
    return [replace(built, path=folder / file) for file, built in _write(folder, makers).items()]


def class_fmu(loaded: LoadedModel, path: Path) -> Path:
    """Build the native FMU of a model's class.

    Parameters have their declared defaults, so that compiling once is enough for all parameter values.

    Raises:
        InputError: The build is impossible.
    """
    _check_compiler(())
    model, kind = loaded.model, cast(Any, type(loaded.model))
    return _compile(_native_of(kind, loaded.source, model.chosen_substep, model.chosen_integrator), path).path


@lru_cache(16)
def _native_of(kind: type[Model], source: str, substep: float | None, integrator: str | None) -> Native:
    """Return the checked native model of a class."""
    return next(_natives(LoadedModel(kind().with_substep(substep, integrator), source), {}))[1]


def _natives(loaded: LoadedModel, starts: Mapping[str, Mapping[str, Value]]) -> Iterator[tuple[str, Native]]:
    """Yield file name and native FMU of a registered model, the plant first, with designed start values by file name.

    For an expression without C equivalent, the error names its line.
    """
    from cosim.fmi.native.package import native_model
    from cosim.model.symbolic.trace import UnprintableModel

    try:
        yield "plant", native_model(loaded.model, loaded.recipe(), f"{type(loaded.model).__name__}Plant")
    except (UnprintableModel, TypeError, AttributeError, RecursionError) as error:
        doing, cure = "cannot be printed as C", "use functions and branches of m in its equations, or omit --native"
        file = loaded.source.rpartition(":")[0]
        text = ModelText(Path(file or loaded.source))
        if isinstance(error, UnprintableModel):
            owner, hook = error.owner or type(loaded.model), error.hook if error.owner else "equations"
            fault = text.fault(owner, hook, f"{doing}: {error}; {error.cure or cure}")
        else:  # RecursionError: of sympy 1.14 for some nested minima and maxima
            fault = text.convert_error(error, doing)
        raise InputError([fault]) from error
    for name, recipe in model_entry(loaded.source).native.items() if is_model(loaded.source) else ():
        yield name, resolve(recipe)(starts.get(f"{name}.fmu"))


def _compile(native: Native, path: Path, fmi: int = 2, platforms: Sequence[str] = ()) -> NativeFmu:
    """Compile and return a native FMU; raise InputError with the compiler's message if compilation fails."""
    from cosim.fmi.native.package import build_native as build_fmu

    try:
        return build_fmu(native, path, fmi, platforms)
    except CompilerFailed as error:
        reason = f"the compiler {error}; repair the compiler, or name another in CC"
        raise InputError.at(Path("--native"), reason) from None


def _check_compiler(platforms: Sequence[str]) -> None:
    """Raise InputError if there is no compiler, before code is generated."""
    try:
        commands(tuple(platforms))
    except NoCompiler as error:
        raise InputError.at(Path("--native"), str(error)) from None


def designed_model(
    text: str | None, nearest: bool, design: FilePath | None, tell: Callable[[str], None]
) -> tuple[LoadedModel, Mapping[str, Mapping[str, Value]]]:
    """Return a model and the start values designed for its controllers: FMU file name → variable → value.

    For a folder written by `cosim refine`, return its refined model, or with `nearest` its nearest model.

    Raises:
        InputError: The model or file is wrong (the error names all faults), or the model has no controller to design.
    """
    if text is None:
        registered = "".join(f"{name}, " for name in sorted(models()) if name != BASE)
        raise InputError.at(Path("--model"), f"is missing; give {registered}a model.yaml, or FILE.py:CLASS")
    loaded, _ = with_substep(load_model(str(refined_file(Path(text), nearest=nearest)), Path()))
    if design is None:
        return loaded, {}
    entry = entry_of(type(loaded.model))
    if entry is None or not entry.design:
        names = ", ".join(sorted(e.name for e in models().values() if e.design)) or "none is installed"
        reason = f"{loaded.model.title} has no controller to design. Models with a controller: {names}"
        raise InputError.at(Path("--design"), reason)
    starts, warnings = resolve(entry.design)(YamlFile(named_path(design)), loaded.model)
    for warning in warnings:
        tell(warning)
    return loaded, dict(starts)
