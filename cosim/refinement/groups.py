"""Parameters per log and groups of logs in a study: names and faults."""

from __future__ import annotations

import os.path
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from cosim.core.errors import Fault
from cosim.core.messages import with_prefix
from cosim.core.text import did_you_mean
from cosim.estimation.subject.interface import Subject
from cosim.files.yaml_file import YamlFile

Groups = Mapping[str, Sequence[str]]  # group → files


@dataclass(frozen=True)
class Arguments:
    """Places of faults in a study written in Python; `path` names the subject."""

    path: Path

    def fault(self, location: Sequence[str | int], message: str, *, key: bool = False) -> Fault:
        """Return a fault of an argument."""
        return Fault(self.path, 0, 0, with_prefix(f"{'.'.join(map(str, location))}: ", message))


Places = YamlFile | Arguments  # of faults in a study's keys


def full_name(subject: Subject, name: str) -> str:
    """Return the full name of a parameter."""
    return f"{name}.value" if name in {kind.name for kind in subject.sensors} else name


def group_of(folder: Path, files: Sequence[str], groups: Groups) -> dict[Path, str]:
    """Return file → group of each log."""
    group = {os.path.realpath(folder / f): name for name, members in groups.items() for f in members}
    return {folder / f: group.get(os.path.realpath(folder / f), f) for f in files}


def per_log_faults(
    places: Places,
    subject: Subject,
    names: Sequence[str] | None,
    groups: Groups,
    logs: Mapping[str, Sequence[str]],
    on_trial: Sequence[str],
) -> Iterator[Fault]:
    """Yield all faults of `per_log` and `groups`.

    Args:
        logs: Files by `estimation` and `validation`.
        on_trial: Candidates named by the study.
    """
    files = [*logs["estimation"], *logs["validation"]]
    yield from _group_faults(places, groups, files)
    if names is None:
        if groups:
            yield places.fault(
                ("groups",),
                (
                    "groups, but no parameter per log; say with per_log which parameters differ between them, or "
                    "leave the groups out"
                ),
                key=True,
            )
        return
    if not names:
        yield places.fault(("per_log",), "names none; name some, or leave the key out", key=True)
    folder = places.path.parent
    group = group_of(folder, files, groups)
    estimated = {group[folder / f] for f in logs["estimation"]}
    alone = [f for f in logs["validation"] if group[folder / f] not in estimated]
    base = [p.name for p in subject.parameters if not isinstance(p.default, bool)]
    of_effects = [n for n in subject.candidate_parameters if n.partition(".")[0] in subject.present]
    allowed, full_names = [*base, *of_effects, *subject.sensor_parameters], set[str]()
    for k, name in enumerate(names):
        place, full = ("per_log", k), full_name(subject, name)
        if full not in allowed:
            yield places.fault(place, _unknown_parameter(subject, name, allowed))
            continue
        if full in full_names:
            yield places.fault(place, f"{name} stands there twice; keep one")
        elif alone and full in subject.inestimable:
            yield places.fault(
                place,
                (
                    f"{name} needs a value for {alone[0]}, which no log of estimation gives, and the filter cannot "
                    f"estimate it during a run; put {alone[0]} in a group with a log of estimation"
                ),
            )
        full_names.add(full)
    for k, name in enumerate(on_trial):
        if ({n for n in subject.declared if n.startswith(f"{name}.")} or {name}) <= full_names:
            yield places.fault(
                ("candidates", k),
                f"{name} is per log too; one per log is free in every hypothesis; name it in one place",
            )


def _group_faults(places: Places, groups: Groups, files: Sequence[str]) -> Iterator[Fault]:
    """Yield faults of unknown, repeated or misnamed groups."""
    folder, owner = places.path.parent, dict[str, str]()
    paths = {os.path.realpath(folder / f) for f in files}
    for group, members in groups.items():
        if group in files:
            yield places.fault(
                ("groups", group), f'a group with the name of the log "{group}"; call it otherwise', key=True
            )
        if not members:
            yield places.fault(("groups", group), f"{group} holds no log; name some, or leave it out", key=True)
        for k, name in enumerate(members):
            path, place = os.path.realpath(folder / name), ("groups", group, k)
            if path not in paths:
                yield places.fault(place, f"{name} is not listed under logs{did_you_mean(name, files)}")
            elif path in owner:
                where = "twice" if owner[path] == group else f"in {owner[path]} too"
                yield places.fault(place, f"{name} stands {where}; a log has one group, keep one")
            owner.setdefault(path, group)


def _unknown_parameter(subject: Subject, name: str, allowed: Sequence[str]) -> str:
    """Return the message on a parameter refused in `per_log`."""
    if name in subject.declared and not isinstance(subject.declared[name].default, bool):
        return (
            f"{name} acts nowhere in the model; an effect that the model lacks is a candidate, so leave "
            f"{name.partition('.')[0]} out"
        )
    own = [n for n in allowed if n.startswith(f"{name}.")]
    short = [kind.name for kind in subject.sensors]
    hint = f"; name its parameters: {', '.join(own)}" if own else did_you_mean(name, [*allowed, *short])
    return f'no parameter "{name}" of the model or of its sensors{hint}'
