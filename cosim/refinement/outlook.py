"""Outlook on a refinement: what `cosim refine` can find with the logs of a study, and what it cannot."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from cosim.core.messages import Note
from cosim.core.text import counted, join_names
from cosim.estimation.subject.fmu_subject import FmuSubject
from cosim.files.artefact import Checking
from cosim.fmi.building.file import skipped_files
from cosim.logs.log import Log
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
    if model.lower().endswith(FMU_SUFFIX) and checking.worker is None and skipped_files.get() is not None:
        read_parts_of_fmu(*keys)
        return [
            f"warning: {model} is not loaded (--no-load), so the names of candidates, noise and tolerance are not "
            "checked"
        ]
    study = read_study(path)
    found = [f"warning: {text}" for text in study.warnings]
    found += [Note(f"not tested: {text}") for text in untested_effects(study)]
    if isinstance(study.subject, FmuSubject):
        found += (text if isinstance(text, Note) else f"warning: {text}" for text in _outlook(study, study.subject))
    return found


def untested_effects(study: Study) -> list[str]:
    """Return the effects that a refinement of this subject with these logs cannot test, each with the reason."""
    subject, logs, named = study.subject, study.logs, study.content.candidates
    varied = [q.name for q in subject.inputs if any(np.ptp(log.inputs[q.name]) > 0.0 for log in logs)]
    still = [q.name for q in subject.inputs if q.name not in varied]
    untested = [subject.untried] if subject.untried else []
    if isinstance(subject, FmuSubject):
        untested += _untested_of_fmu(subject, logs, still)
    elif still:
        possible = {c.name for c in subject.candidates([q.name for q in subject.inputs])}
        left_out = sorted(possible - {c.name for c in subject.candidates(varied)})
        untested += [f"{join_names(left_out)} (constant in all logs: {join_names(still)})"] if left_out else []
    if named is not None:
        untested.append(f"effects beside the {counted(len(named), 'candidate')} that the study names")
    return untested


def _untested_of_fmu(subject: FmuSubject, logs: Sequence[Log], still: Sequence[str]) -> Iterator[str]:
    """Yield the terms and parameters of an FMU that cannot be tested.

    Args:
        still: Inputs that never change in the estimation logs.
    """
    s, names = subject.structure, subject.names
    logged = set[str]().union(*(log.outputs for log in logs))
    one_way = []  # velocities that keep their sign in all logs
    for pair in s.pairs:
        name = with_place(s.shown_as(pair.velocity))
        readings = np.concatenate([np.zeros(0), *(log.outputs[name] for log in logs if name in log.outputs)])
        if readings.size and (np.nanmin(readings) >= 0.0 or np.nanmax(readings) <= 0.0):
            one_way.append(pair.velocity)
    for text, places in (
        ("terms at inputs that are constant in all logs ({})", [q.name for q in s.inputs if names[q.name] in still]),
        ("sensor errors of outputs that no log has ({})", [q.name for q in s.outputs if names[q.name] not in logged]),
        ("parameters that change no output ({})", [p.name for p in s.parameters if not (p.acts or p.starts)]),
        (
            "forces where no input acts, in co-simulation ({})",
            [p.velocity for p in s.pairs if subject.is_stepped and not p.ports],
        ),
        ("dry friction in contrast to a constant force, where the velocity never reverses ({})", one_way),
    ):
        if places:
            yield text.format(join_names(places))
    if not s.pairs:
        yield "friction and other forces (no output is recognised as a position or its rate)"


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
    """Yield interface, number of candidates and their places, and what these logs do not suffice for."""
    s, logs = subject.structure, study.logs
    count = len(subject.candidates([q.name for q in subject.inputs]))
    yield Note(f"`cosim refine` will use {subject.source.removeprefix(f'{s.fmu}, ')}")
    yield Note(f"`cosim refine` will try {count} terms and parameters: {'; '.join(_places(s))}")
    if subject.is_stepped and len({log.path for log in logs}) < FEWEST_STEPPED:
        yield (
            f"co-simulation has free runs only, so at least {FEWEST_STEPPED} estimation logs are needed to judge "
            "a claim"
        )
    if not study.content.logs.validation:
        yield Note(
            f"no validation log: a claim from {counted(len(study.content.logs.estimation), 'log')} will not be "
            "proven on data that no decision has used"
        )
