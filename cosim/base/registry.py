"""Models, report pages, array twins, formats of tables, coupling algorithms and verbs that packages register.

They register through entry points; each names an object of the classes below. Nothing is imported before it is asked
for, so that a study of one model never loads another. docs/extending.md shows a package that registers something.
"""

from __future__ import annotations

import functools
import pkgutil
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, PackageNotFoundError, entry_points, version
from pathlib import Path
from typing import Any

from cosim.base.errors import Fault, InputError

MODELS, PAGES, TWINS, VERBS = "cosim.models", "cosim.pages", "cosim.twins", "cosim.verbs"  # groups of entry points
SOURCES = "cosim.sources"  # formats of tables: `cosim.storage.table_source.Source`
ALGORITHMS = "cosim.algorithms"  # coupling algorithms: `cosim.coupling.algorithms.Algorithm`
BASE = "base"  # the model that is meant where none is named
FORMER = "cosim-hovercraft"  # a distribution that held framework and example in one, and registers nothing


class ExtensionWarning(UserWarning):
    """An installed package registers something that cannot be loaded."""


@dataclass(frozen=True)
class ModelEntry:
    """A model under a name, with what belongs to it. Places are `module:object`, "" where there is none.

    name:       what files call the model
    model:      place of its class
    recipe:     place of the function that returns the recipe of its FMU from parameter values
    built:      file name → place of a recipe: the FMUs of `cosim build` without a model
    beside:     file name → place of a recipe: FMUs that are built beside each model of this class
    native:     name → place of what makes a native FMU beside the model's own
    rig:        place of the class that plays its experiments
    design:     place of the designer of its controller, behind `design:` of a scenario
    cases:      place of its estimators and of the truths that they are judged against
    estimators: place of a function of (case, runs, steps, random numbers) that returns the normalised errors and
                innovations of one estimator
    """

    name: str
    model: str
    recipe: str
    built: Mapping[str, str] = field(default_factory=dict)
    beside: Mapping[str, str] = field(default_factory=dict)
    native: Mapping[str, str] = field(default_factory=dict)
    rig: str = ""
    design: str = ""
    cases: str = ""
    estimators: str = ""


@dataclass(frozen=True)
class Page:
    """A report page about runs that have a component with certain variables.

    variables: names that the component has
    subject:   place of a function of (run, drawing) that returns the `ComponentPage`
    figures:   place of a function of (run, folder) that draws PNG files, "" for those of any run
    """

    variables: frozenset[str]
    subject: str
    figures: str = ""


@dataclass(frozen=True)
class Verb:
    """A verb that a package adds, declared as cosim's own modules of `cosim.verbs` are. Places are `module:object`.

    command:   place of the function behind `cosim NAME`, typer's options its parameters; "" if there is no command
    function:  place of the function that `cosim.NAME` is in Python; "" if there is none
    artefacts: place of a tuple of `Artefact` (cosim/storage/artefact.py), the files that the verb reads and writes
    group:     heading of the verb in `cosim -h`: one of cosim's (cosim/verbs/__init__.py), or a new one
    """

    command: str = ""
    function: str = ""
    artefacts: str = ""
    group: str = ""


def models() -> dict[str, ModelEntry]:
    """Return the models that go by a name, each once and under its own."""
    entries = {name: load(MODELS, name) for name in names(MODELS)}
    return {e.name: e for e in entries.values() if isinstance(e, ModelEntry)}


def model_entry(name: str = BASE) -> ModelEntry:
    """Return the model of a name; InputError where there is none, which says what to name instead."""
    found = load(MODELS, name) if name in names(MODELS) else None
    if not isinstance(found, ModelEntry):
        raise InputError([Fault(Path("model"), 0, 0, f'no model "{name}" is installed; {cure_without_base()}')])
    return found


def is_model(name: str) -> bool:
    """Return whether a model is registered under a name."""
    return name in names(MODELS)


def cure_without_base() -> str:
    """Return what to do where no model is registered as `base`."""
    cure = "name a model.yaml or FILE.py:Class of your own"
    try:
        version(FORMER)
    except PackageNotFoundError:
        return cure
    return f"{FORMER} of an earlier release is installed, which registers nothing: pip uninstall {FORMER}; or {cure}"


def entry_of(kind: type) -> ModelEntry | None:
    """Return what is registered for a class of models, or for the nearest class that it is made from."""
    places = (f"{parent.__module__}:{parent.__qualname__}" for parent in kind.__mro__)
    return next((e for place in places for e in models().values() if e.model == place), None)


def rig_of(kind: type, otherwise: Any) -> Any:
    """Return what plays experiments of a class of models."""
    entry = entry_of(kind)
    return resolve(entry.rig) if entry and entry.rig else otherwise


def page_for(components: Iterable[Collection[str]]) -> Page | None:
    """Return the page for a run with components of these variables, if there is one."""
    sets = [set(variables) for variables in components]
    pages = (page for name in names(PAGES) if isinstance(page := load(PAGES, name), Page))
    return next((page for page in pages if any(page.variables <= variables for variables in sets)), None)


def twin_of(model_name: str) -> Any:
    """Return the class that does for many runs at once what the FMU of a modelName does; None where there is none."""
    return load(TWINS, model_name) if model_name in names(TWINS) else None


def added_verbs() -> Iterator[tuple[str, Verb]]:
    """Yield the verbs that packages add, by name."""
    for name in names(VERBS):
        if isinstance(found := load(VERBS, name), Verb):
            yield name, found


def names(group: str) -> list[str]:
    """Return the names that are registered in a group, in alphabetical order."""
    return sorted(_registered(group))


def load(group: str, name: str) -> Any:
    """Return the object registered under a name; None, with one warning, where it cannot be imported.

    InputError where two packages register the name.
    """
    points = _registered(group)[name]
    if len(points) > 1:
        owners = " and ".join(sorted(_owner(point) for point in points))
        message = f'"{name}" is registered by {owners}; uninstall one of them'
        raise InputError([Fault(Path(group), 0, 0, message)])
    return _loaded(points[0])


def resolve(place: str) -> Any:
    """Return the object at `module:name`, imported now."""
    return pkgutil.resolve_name(place)


def attempt(name: str, place: str) -> Any:
    """Return the object at a place that a verb names; None, with one warning, where it cannot be imported."""
    try:
        return resolve(place)
    except Exception as error:  # whatever a package of others does when it is imported
        warnings.warn(f"{name}: {place} cannot be loaded: {error}", ExtensionWarning, stacklevel=2)
        return None


@functools.cache
def _registered(group: str) -> dict[str, tuple[EntryPoint, ...]]:
    found: dict[str, dict[tuple[str, str], EntryPoint]] = {}
    for point in entry_points(group=group):
        # a package found twice on the path, as beside its own source, registers once
        found.setdefault(point.name, {})[_owner(point), point.value] = point
    return {name: tuple(points.values()) for name, points in found.items()}


@functools.cache
def _loaded(point: EntryPoint) -> Any:
    try:
        return point.load()
    except Exception as error:  # whatever a package of others does when it is imported
        message = f"{_owner(point)}: the entry point {point.group}:{point.name} cannot be loaded: {error}"
        warnings.warn(message, ExtensionWarning, stacklevel=2)
        return None


def _owner(point: EntryPoint) -> str:
    return point.dist.name if point.dist is not None else point.value
