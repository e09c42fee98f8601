"""Outlook on a refinement: what `cosim refine` can find in an FMU with the logs of a study, and what it cannot."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from operator import attrgetter
from pathlib import Path

import numpy as np

from cosim.core.messages import Note
from cosim.core.text import counted, join_names
from cosim.estimation.subject.fmu_subject import FmuSubject
from cosim.files.artefact import Checking
from cosim.files.yaml_file import YamlFile
from cosim.fmi.building.file import is_execution_allowed
from cosim.logs.log import Log
from cosim.probing.fmu_structure import Pair, Structure
from cosim.refinement.study import FMU_SUFFIX, Study, keys_of, read_parts_of_fmu, read_study
from cosim.terms.language import with_place

FEWEST_STEPPED = 2  # estimation logs in co-simulation, where the filter has no process noise inside the FMU
RARE = 0.02  # least share of rows against the usual direction, for a velocity that reverses


def check_study(path: Path, checking: Checking) -> list[str]:
    """Return the warnings of a study, and what a refinement can find in its FMU.

    Raises:
        InputError: The study has faults.
    """
    content = YamlFile(path).root
    model = str(content.get("model", "")) if isinstance(content, dict) else ""
    if model.lower().endswith(FMU_SUFFIX) and checking.worker is None and not is_execution_allowed():
        read_parts_of_fmu(*keys_of(path))
        return [
            f"warning: {model} is not loaded (--no-load), so the names of candidates, noise and tolerance are not "
            "checked"
        ]
    study = read_study(path)
    return [
        *(f"warning: {text}" for text in study.warnings),
        *(text if isinstance(text, Note) else f"warning: {text}" for text in outlook(study)),
    ]


def outlook(study: Study) -> list[str]:
    """Return plans and blind spots of a refinement: interface, places and number of candidates."""
    subject = study.subject
    if not isinstance(subject, FmuSubject):
        return []
    structure, count = subject.structure, len(subject.candidates([q.name for q in subject.inputs]))
    return [
        Note(f"`cosim refine` will use {subject.source.removeprefix(f'{structure.fmu}, ')}"),
        Note(f"`cosim refine` will try {count} terms and parameters: {'; '.join(_places(structure))}"),
        *_blind_spots(study, subject),
    ]


def _places(s: Structure) -> Iterator[str]:
    """Yield each kind of place with its names."""
    velocities = [_force_place(s, p) for p in s.pairs if p.ports or s.way == "model-exchange"]
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


def _force_place(s: Structure, pair: Pair) -> str:
    ports = [p.input for p in pair.ports]
    damping = next((d.parameter for d in s.directions if d.pair == pair and d.in_step), "")
    if damping:
        return f"{pair.velocity} (as {damping} acts)"
    return f"{pair.velocity} (through {ports[0]})" if ports else pair.velocity


def _blind_spots(study: Study, subject: FmuSubject) -> Iterator[str]:
    """Yield what these logs, or this interface, cannot show."""
    s, logs, names, is_stepped = subject.structure, study.logs, subject.names, subject.structure.way == "co-simulation"
    logged = set().union(*(log.outputs for log in logs))
    places = (
        (
            "terms at {}, which never changes in the estimation logs",
            [q.name for q in s.inputs if not any(np.ptp(log.inputs[names[q.name]]) > 0.0 for log in logs)],
        ),
        (
            "errors of the sensors of {}, which no estimation log has",
            [q.name for q in s.outputs if names[q.name] not in logged],
        ),
        ("{}, which changes no output along these logs", s.idle),
        (
            "forces at {}, because no input acts there and co-simulation gives no access to derivatives",
            [p.velocity for p in s.pairs if is_stepped and not p.ports],
        ),
        (
            "dry friction at {} apart from a constant force, because the velocity never reverses",
            [p.velocity for p in s.pairs if _goes_one_way(logs, with_place(s.shown_as(p.velocity)))],
        ),
    )
    yield from (f"not visible: {text.format(join_names(names))}" for text, names in places if names)
    if is_stepped and len(set(map(attrgetter("path"), logs))) < FEWEST_STEPPED:
        yield (
            f"co-simulation has free runs only, so at least {FEWEST_STEPPED} estimation logs are needed to judge "
            "a claim"
        )
    if not study.content.logs.validation:
        yield Note(
            f"no validation log: a claim from {counted(len(study.content.logs.estimation), 'log')} will not be "
            "proven on data that no decision has used"
        )


def _goes_one_way(logs: Sequence[Log], name: str) -> bool:
    """Return whether a measured velocity keeps its sign in all logs; False for one that no log has."""
    readings = [log.outputs[name] for log in logs if name in log.outputs]
    if not readings:
        return False
    values = np.concatenate(readings)
    values = values[np.isfinite(values)]
    return bool(values.size and min(np.mean(values > 0.0), np.mean(values < 0.0)) < RARE)
