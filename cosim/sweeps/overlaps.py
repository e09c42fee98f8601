"""Overlapping entries of a sweep: two entries for the same value, of which only the later acts."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any

from cosim.base.errors import Fault
from cosim.base.messages import Template
from cosim.scenario.scenario_file import keys_of
from cosim.storage.yaml_file import YamlFile
from cosim.sweeps import messages
from cosim.sweeps.sweep_file import SweepFile

Place = tuple[str, ...]


def overlap_faults(yaml: YamlFile, file: SweepFile, components: Collection[str]) -> Iterator[Fault]:
    """Yield a fault for each entry of `vary` and `set` that another entry overrides.

    In a run, start values override paths, and `vary` overrides `set`. A path includes everything below it. Setting a
    whole and varying a part of it is allowed.
    """
    varied = {name: place_of(name, components) for name in file.vary}
    fixed = {name: place_of(name, ()) for name in file.set}
    vary_order, set_order = list(file.vary), list(file.set)
    for one, other in dict.fromkeys(tuple(sorted(pair, key=vary_order.index)) for pair in _pairs(varied, varied)):
        part = max(varied[one], varied[other], key=len)
        yield _fault(yaml, ("vary", other), ("vary", one), messages.VARIED_TWICE, place=".".join(part))
    for inner, whole in _pairs(fixed, fixed):
        if set_order.index(whole) > set_order.index(inner):
            place = ".".join(fixed[inner])
            yield _fault(yaml, ("set", whole), ("set", inner), messages.WHOLE_AFTER_PART, place=place)
    for inner, whole in _pairs(fixed, varied):
        if whole != "seed" or file.vary[whole].count is None:  # Counted seeds start from the seed in `set`.
            place = ".".join(fixed[inner])
            yield _fault(yaml, ("set", inner), ("vary", whole), messages.SET_AND_VARIED, place=place)


def place_of(name: str, components: Collection[str]) -> Place:
    """Return the place of an entry in a scenario. `component.variable` is a start value."""
    component, _, variable = name.partition(".")
    if component in components:
        return "components", component, "start", variable
    return tuple(str(int(k)) if k.isascii() and k.isdigit() else k for k in keys_of(name.strip()))


def _pairs(parts: Mapping[str, Place], wholes: Mapping[str, Place]) -> Iterator[tuple[str, str]]:
    """Yield pairs of an entry and another containing it."""
    at: dict[Place, list[str]] = {}
    for name, place in wholes.items():
        at.setdefault(place, []).append(name)
    for part, place in parts.items():
        for length in range(1, len(place) + 1):
            candidates = at.get(place[:length], ())
            yield from ((part, whole) for whole in candidates if whole != part or parts is not wholes)


def _fault(yaml: YamlFile, where: Place, other: Place, template: Template, **fields: Any) -> Fault:
    line = yaml.place(other, key=True)[0]
    return yaml.fault(where, template(entry=where[-1], other=other[-1], line=line, **fields), key=True)
