"""Registry of models, report pages, table formats, coupling algorithms and verbs of packages.

A package registers objects of the classes below through entry points. An object is imported on first use, so that a
study of one model loads no other model. docs/extending.md shows an example package.
"""

from __future__ import annotations

import functools
import pkgutil
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, TypeVar

from cosim.core.errors import InputError

T = TypeVar("T")
MODELS_GROUP, PAGES_GROUP, VERBS_GROUP = "cosim.models", "cosim.pages", "cosim.verbs"  # entry point groups
SOURCES_GROUP = "cosim.sources"  # table formats: `cosim.files.table.Source`
ALGORITHMS = "cosim.algorithms"  # coupling algorithms: `cosim.blocks.coupling.Algorithm`
BASE = "base"  # model used by default


class ExtensionWarning(UserWarning):
    """An object that an installed package registers cannot be imported."""


@dataclass(frozen=True)
class ModelEntry:
    """A model with a registered name, and its related objects. A place has the form `module:object`; "" if absent.

    Attributes:
        name: Name of the model in studies and on the command line.
        model: Place of the model's class.
        recipe: Place of a function that returns the recipe of the model's FMU (`Recipe`) for given parameter values.
        built: File name → place of a recipe, for each FMU that `cosim build --model NAME` builds.
        beside: File name → place of a recipe, for additional FMUs that are built with every model of this class.
        native: Name → place of a function that builds an additional native FMU. The function takes the designed start
            values of `NAME.fmu`, if any.
        rig: Place of the class that runs experiments with the model.
        design: Place of the function behind `cosim build --design`. It takes a YAML file and a model, and returns
            designed start values by file name, for FMUs in `beside`, and warnings. "" for a model without controller.
    """

    name: str
    model: str
    recipe: str
    built: Mapping[str, str] = field(default_factory=dict)
    beside: Mapping[str, str] = field(default_factory=dict)
    native: Mapping[str, str] = field(default_factory=dict)
    rig: str = ""
    design: str = ""


@dataclass(frozen=True)
class Page:
    """A report page for every run that has a component with certain variables.

    Attributes:
        variables: Names of variables that the component must have.
        subject: Place of a function from (run, drawing) to a `ComponentPage`.
    """

    variables: frozenset[str]
    subject: str


@dataclass(frozen=True)
class Verb:
    """A verb of another package, with the same entries as cosim's own verbs in `cosim.verbs`.

    Attributes:
        command: Place `module:object` of the function behind `cosim NAME`; its parameters are the command's options.
            "" if the verb is not a command.
        function: Place of the function `cosim.NAME` in Python; "" if the verb is not a function.
        artefacts: Place of a tuple of `Artefact` (cosim/files/artefact.py): the files that the verb reads and writes.
        group: Heading of the verb in `cosim -h`: one of cosim's headings (cosim/verbs/__init__.py), or a new one.
    """

    command: str = ""
    function: str = ""
    artefacts: str = ""
    group: str = ""


def models() -> dict[str, ModelEntry]:
    """Return the registered models by their own names."""
    return {entry.name: entry for _, entry in registered(MODELS_GROUP, ModelEntry)}


def model_entry(name: str = BASE) -> ModelEntry:
    """Return a model by name; raise InputError if unknown."""
    entry = load(MODELS_GROUP, name) if name in names(MODELS_GROUP) else None
    if not isinstance(entry, ModelEntry):
        raise InputError.at(
            Path("model"), f'no model "{name}" is installed; give a model.yaml, or a class of your own as FILE.py:Class'
        )
    return entry


def is_model(name: str) -> bool:
    """Return True if a model is registered under a name."""
    return name in names(MODELS_GROUP)


def entry_of(kind: type) -> ModelEntry | None:
    """Return the registry entry of a model's class or of its nearest registered base class."""
    places = (f"{parent.__module__}:{parent.__qualname__}" for parent in kind.__mro__)
    return next((e for place in places for e in models().values() if e.model == place), None)


def page_for(components: Iterable[Collection[str]]) -> Page | None:
    """Return the first registered page that fits one of the components, of which the variable names are given."""
    sets = [frozenset(variables) for variables in components]
    return next((page for _, page in registered(PAGES_GROUP, Page) if any(map(page.variables.issubset, sets))), None)


def registered(group: str, kind: type[T]) -> Iterator[tuple[str, T]]:
    """Yield name and object for each object of class `kind` that installed packages register in a group."""
    for name in names(group):
        if isinstance(found := load(group, name), kind):
            yield name, found


def names(group: str) -> list[str]:
    """Return the names registered in a group, sorted."""
    return sorted(_points_of_group(group))


@functools.cache
def load(group: str, name: str) -> Any:
    """Return the object registered under a name; None, with a warning, if its import fails.

    Raises:
        InputError: Two packages register the name.
    """
    points = _points_of_group(group)[name]
    if len(points) > 1:  # Of a package that is on the path twice, each entry point appears twice.
        points = [*{(_owner(point), point.value): point for point in points}.values()]
    if len(points) > 1:
        owners = " and ".join(sorted(map(_owner, points)))
        raise InputError.at(Path(group), f'"{name}" is registered by {owners}; uninstall one of them')
    try:
        return points[0].load()
    except Exception as error:  # Foreign packages may raise any error when imported.
        message = f"{_owner(points[0])}: the entry point {group}:{name} cannot be loaded: {error}"
        warnings.warn(message, ExtensionWarning, stacklevel=2)
        return None


def resolve(place: str) -> Any:
    """Import and return the object at `module:name`."""
    return pkgutil.resolve_name(place)


def attempt(name: str, place: str) -> Any:
    """Return the object of a verb at `module:name`; None, with a warning, if the import fails."""
    try:
        return resolve(place)
    except Exception as error:  # Foreign packages may raise any error when imported.
        warnings.warn(f"{name}: {place} cannot be loaded: {error}", ExtensionWarning, stacklevel=2)
        return None


_all_points = functools.cache(entry_points)  # this lookup reads a file of every installed package


@functools.cache
def _points_of_group(group: str) -> dict[str, list[EntryPoint]]:
    by_name: dict[str, list[EntryPoint]] = {}
    for point in _all_points().select(group=group):
        by_name.setdefault(point.name, []).append(point)
    return by_name


def _owner(point: EntryPoint) -> str:
    return point.dist.name if point.dist is not None else point.value
