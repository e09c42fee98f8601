"""Checks of the names in a user's model: unique, and defined if referred to."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain

from cosim.fmi.ports import model_ports
from cosim.model.model import Model
from cosim.model.planar import PlanarFrame
from cosim.model.quantities import parameters_of
from cosim.storage.yaml_file import did_you_mean

Faults = Iterator[tuple[type, str, str]]  # class, declaration, message


def duplicate_names(kind: type[Model]) -> Faults:
    """Yield faults of names with two meanings."""
    for name in ("base_states", "inputs", "outputs"):
        yield from _duplicates(kind, name, [q.name for q in getattr(kind, name)])
    if any(q.name == "time" for q in (*kind.inputs, *kind.outputs)):
        yield kind, "", 'an input or output is called "time", which is the first column of a log; give it another name'
    parameters = {p.name for p in parameters_of(kind)}
    for name, count in Counter(k.name for k in (*kind.catalogue, *kind.sensors)).items():
        last = next(k for k in (*reversed(kind.sensors), *reversed(kind.catalogue)) if k.name == name)
        if count > 1:
            yield last, "name", f'{count} effects or sensor errors are called "{name}"; give each its own name'
        if name in parameters:
            yield last, "name", f'"{name}" is a parameter of the model too; give the effect another name'


def _duplicates(owner: type, attribute: str, names: Sequence[str]) -> Faults:
    for name, count in Counter(names).items():
        if count > 1:
            yield owner, attribute, f'{attribute} has {count} called "{name}"; give each its own name'


def duplicate_variables(model: Model) -> Faults:
    """Yield faults of FMU variables with the same name."""
    for name, count in Counter(port.name for port in model_ports(model)).items():
        if count > 1:
            yield (
                type(model),
                "",
                (
                    f'{count} of its inputs, outputs, parameters and start values ("state_start") are called '
                    f'"{name}"; give each its own name'
                ),
            )


def undefined_names(kind: type[Model]) -> Faults:
    """Yield a fault for each declaration that refers to an undefined name."""
    if kind.planar is not None and not isinstance(kind.planar, PlanarFrame):
        fields = ", ".join(f'{field.name}="…"' for field in dataclasses.fields(PlanarFrame))
        yield kind, "planar", f"planar is a PlanarFrame({fields}) of outputs, or None"
    if kind.base_states and not kind.forced:
        yield (
            kind,
            "forced",
            (
                "forced names no state; name those whose equations may lack something, the accelerations usually "
                f"(states: {', '.join(q.name for q in kind.base_states)})"
            ),
        )
    for attribute, sort, references, names in _references(kind):
        fields = {"attribute": attribute, "kind": sort, "names": ", ".join(names) or "none"}
        for name in dict.fromkeys(references):
            if name not in names:
                cure, kinds = did_you_mean(str(name), names), sort.replace(" or", "s or") + "s"
                yield (
                    kind,
                    attribute,
                    '{attribute}: no {kind} "{name}"{cure} ({kinds}: {names})'.format(
                        name=name, cure=cure, kinds=kinds, **fields
                    ),
                )
    for attribute in ("forced", "calibrated", "measured"):
        yield from _duplicates(kind, attribute, getattr(kind, attribute))
    for name in kind.suspect:
        if name in kind.calibrated:
            yield kind, "suspect", f'"{name}" is in calibrated too; leave it out of suspect'


def _references(kind: type[Model]) -> list[tuple[str, str, Iterable[str], list[str]]]:
    """Return the declarations that refer to names: attribute, kind of name, used names and defined names."""
    states, inputs, outputs = ([q.name for q in group] for group in (kind.base_states, kind.inputs, kind.outputs))
    numbers = [p.name for p in parameters_of(kind) if not isinstance(p.default, bool)]
    candidates = [*(k.name for k in (*kind.catalogue, *kind.sensors)), *numbers]
    return [
        ("forced", "state", kind.forced, states),
        ("calibrated", "parameter", kind.calibrated, numbers),
        ("suspect", "parameter", kind.suspect, numbers),
        ("suspect", "input", chain.from_iterable(kind.suspect.values()), inputs),
        ("sensor_variance", "output", kind.sensor_variance, outputs),
        ("start_variance", "state", kind.start_variance, states),
        ("measured", "output", kind.measured, outputs),
        ("excursion", "input or output", kind.excursion, [*inputs, *outputs]),
        ("valid", "input", chain.from_iterable(v.inputs for v in kind.valid), inputs),
        ("planar", "output", kind.planar.names if isinstance(kind.planar, PlanarFrame) else (), outputs),
        ("told_apart_by", "candidate", sorted(chain.from_iterable(kind.told_apart_by)), candidates),
        ("drawn_against", "candidate", kind.drawn_against, candidates),
    ]
