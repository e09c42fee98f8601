"""Overlapping entries of a sweep: two entries for the same value, of which only the later acts."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

from cosim.base.errors import Fault
from cosim.scenario.scenario_file import keys_of
from cosim.storage.yaml_file import YamlFile
from cosim.sweeps.sweep_file import SweepFile

Place = tuple[str, ...]


def overlap_faults(
    yaml: YamlFile, file: SweepFile, components: Collection[str], designed: str | None
) -> Iterator[Fault]:
    """Yield a fault for each overridden entry of `vary` and `set`.

    In a run, start values override paths, and `vary` overrides `set`. A path includes everything below it. Setting a
    whole and varying a part of it is allowed.

    Args:
        designed: Component of `design:`, if any.
    """
    varied = {name: place_of(name, components) for name in file.vary}
    given = {name: place_of(name, ()) for name in file.set}
    vary_order, set_order = ({name: k for k, name in enumerate(names)} for names in (file.vary, file.set))
    for one, other in dict.fromkeys(
        tuple(sorted(pair, key=lambda name: vary_order[name])) for pair in _pairs(varied, varied)
    ):
        part = max(varied[one], varied[other], key=lambda place: len(place))
        said = f"both give {'.'.join(part)}; vary one of them"
        yield _fault(yaml, ("vary", other), ("vary", one), said)
    for inner, whole in _pairs(given, given):
        if set_order[whole] > set_order[inner]:
            said = f"both give {'.'.join(given[inner])}, and the later is put over it; set the whole first, then a part"
            yield _fault(yaml, ("set", whole), ("set", inner), said)
    for inner, whole in _pairs(given, varied):
        if whole != "seed" or file.vary[whole].count is None:  # Counted seeds start from the seed in `set`.
            said = f"both give {'.'.join(given[inner])}, and what varies goes over it; leave it out of set"
            yield _fault(yaml, ("set", inner), ("vary", whole), said)
    yield from _designed(yaml, file, varied, given, ("components", designed or "", "start"))


def _designed(
    yaml: YamlFile, file: SweepFile, varied: Mapping[str, Place], given: Mapping[str, Place], start: Place
) -> Iterator[Fault]:
    """Yield faults of names given as design option and start value. An example is the name of an estimator."""
    for key, entries in (("vary", varied), ("set", given)):
        options = {place[1]: name for name, place in entries.items() if place[0] == "design" and len(place) == 2}
        for name, place in varied.items():
            option = options.get(place[-1]) if place[:-1] == start else None
            if option is not None and any(isinstance(v, str) and v[:1].isalpha() for v in file.vary[name].values or ()):
                said = "the design gives that start value, and the component's own goes over it; keep one of them"
                yield _fault(yaml, ("vary", name), (key, option), said)


def place_of(name: str, components: Collection[str]) -> Place:
    """Return the place of an entry in a scenario. `component.variable` is a start value."""
    component, _, variable = name.partition(".")
    if component in components:
        return "components", component, "start", variable
    return tuple(str(int(k)) if k.isascii() and k.isdigit() else k for k in keys_of(name.strip()))


def _pairs(parts: Mapping[str, Place], wholes: Mapping[str, Place]) -> Iterator[tuple[str, str]]:
    """Yield pairs of an entry and another entry containing it."""
    at: dict[Place, list[str]] = {}
    for name, place in wholes.items():
        at.setdefault(place, []).append(name)
    for part, place in parts.items():
        for length in range(1, len(place) + 1):
            whole_ones = at.get(place[:length], ())
            yield from ((part, whole) for whole in whole_ones if whole != part or parts is not wholes)


def _fault(yaml: YamlFile, where: Place, other: Place, said: str) -> Fault:
    line = yaml.fault(other, "", key=True).line
    return yaml.fault(where, f'{where[-1]} and "{other[-1]}" of line {line}: {said}', key=True)
