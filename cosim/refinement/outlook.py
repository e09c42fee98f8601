"""Outlook on a refinement: what `cosim refine` can find in an FMU with the logs of a study, and what it cannot."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from cosim.core.messages import Note
from cosim.core.text import counted, join_names
from cosim.estimation.subject.fmu_subject import FmuSubject
from cosim.files.artefact import Checking
from cosim.fmi.building.execution import is_execution_allowed
from cosim.probing.fmu_structure import Structure
from cosim.refinement.study import FMU_SUFFIX, Study, keys_of, read_parts_of_fmu, read_study
from cosim.terms.language import with_place

FEWEST_STEPPED = 2  # estimation logs in co-simulation, where the filter has no process noise inside the FMU


def check_study(path: Path, checking: Checking) -> list[str]:
    """Return the warnings of a study, and what a refinement can find in its FMU.

    Raises:
        InputError: The study has faults.
    """
    keys = keys_of(path)
    model = keys[1].model
    if model.lower().endswith(FMU_SUFFIX) and checking.worker is None and not is_execution_allowed():
        read_parts_of_fmu(*keys)
        return [
            f"warning: {model} is not loaded (--no-load), so the names of candidates, noise and tolerance are not "
            "checked"
        ]
    study = read_study(path)
    found = [f"warning: {text}" for text in study.warnings]
    if isinstance(study.subject, FmuSubject):
        found += (text if isinstance(text, Note) else f"warning: {text}" for text in _outlook(study, study.subject))
    return found


def _places(s: Structure) -> Iterator[str]:
    """Yield each kind of place with its names."""
    velocities = []
    for pair in (p for p in s.pairs if p.ports or s.way == "model-exchange"):
        damping = next((f" (as {d.parameter} acts)" for d in s.directions if d.pair == pair and d.in_step), "")
        through = f" (through {pair.ports[0].input})" if pair.ports else ""
        velocities.append(f"{pair.velocity}{damping or through}")
    for text, names in (
        ("at inputs", [q.name for q in s.inputs]),
        ("forces at", velocities),
        ("between", [f"{c.first.velocity} and {c.second.velocity}" for c in s.connections]),
        ("at storages", list(s.storages)),
        ("at sensors", [q.name for q in s.outputs]),
        ("parameters", [p.name for p in s.acting]),
    ):
        if names:
            yield f"{text} {join_names(names)}"


def _outlook(study: Study, subject: FmuSubject) -> Iterator[str]:
    """Yield interface, number of candidates and their places, and what these logs, or this interface, cannot show."""
    s, logs, names, is_stepped = subject.structure, study.logs, subject.names, subject.structure.way == "co-simulation"
    count = len(subject.candidates([q.name for q in subject.inputs]))
    yield Note(f"`cosim refine` will use {subject.source.removeprefix(f'{s.fmu}, ')}")
    yield Note(f"`cosim refine` will try {count} terms and parameters: {'; '.join(_places(s))}")
    logged = set().union(*(log.outputs for log in logs))
    one_way = []  # velocities that keep their sign in all logs
    for pair in s.pairs:
        name = with_place(s.shown_as(pair.velocity))
        readings = np.concatenate([np.zeros(0), *(log.outputs[name] for log in logs if name in log.outputs)])
        if readings.size and (np.nanmin(readings) >= 0.0 or np.nanmax(readings) <= 0.0):
            one_way.append(pair.velocity)
    places = (
        (
            "terms at {}, which never changes in the estimation logs",
            [q.name for q in s.inputs if not any(np.ptp(log.inputs[names[q.name]]) > 0.0 for log in logs)],
        ),
        (
            "errors of the sensors of {}, which no estimation log has",
            [q.name for q in s.outputs if names[q.name] not in logged],
        ),
        (
            "{}, which changes no output along these logs",
            [p.name for p in s.parameters if not (p.acts or p.starts)],
        ),
        (
            "forces at {}, because no input acts there and co-simulation gives no access to derivatives",
            [p.velocity for p in s.pairs if is_stepped and not p.ports],
        ),
        (
            "dry friction at {} apart from a constant force, because the velocity never reverses",
            one_way,
        ),
    )
    yield from (f"not visible: {text.format(join_names(names))}" for text, names in places if names)
    if is_stepped and len({log.path for log in logs}) < FEWEST_STEPPED:
        yield (
            f"co-simulation has free runs only, so at least {FEWEST_STEPPED} estimation logs are needed to judge "
            "a claim"
        )
    if not study.content.logs.validation:
        yield Note(
            f"no validation log: a claim from {counted(len(study.content.logs.estimation), 'log')} will not be "
            "proven on data that no decision has used"
        )
