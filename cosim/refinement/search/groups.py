"""Parameters per log and groups of logs in a study: names and faults."""

from __future__ import annotations

import os.path
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from cosim.base.errors import Fault
from cosim.storage.yaml_file import did_you_mean
from cosim.subject.interface import Subject

Groups = Mapping[str, Sequence[str]]  # group → files


class Places(Protocol):
    """Location of a study's keys: a `YamlFile` or the arguments of a call."""

    @property
    def path(self) -> Path:
        """Return the file of the study."""

    def fault(self, location: Any, message: str, *, key: bool = False) -> Fault:
        """Return a fault at a key."""


def full_name(subject: Subject, name: str) -> str:
    """Return the full name of a parameter."""
    return f"{name}.value" if name in {kind.name for kind in subject.sensors} else name


def numbers_of(subject: Subject) -> list[str]:
    """Return the parameters that may be per log."""
    base = [p.name for p in subject.parameters if not isinstance(p.default, bool)]
    of_effects = [n for n in subject.candidate_parameters if n.partition(".")[0] in subject.present]
    return [*base, *of_effects, *subject.sensor_parameters]


def group_of(folder: Path, files: Sequence[str], groups: Groups) -> dict[Path, str]:
    """Return file → group of each log."""
    named = {os.path.realpath(folder / f): group for group, members in groups.items() for f in members}
    return {folder / f: named.get(os.path.realpath(folder / f), f) for f in files}


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
    yield from _wrong_groups(places, groups, [*logs["estimation"], *logs["validation"]])
    if names is None:
        if groups:
            cure = "say with per_log which parameters differ between them, or leave the groups out"
            yield places.fault(("groups",), f"groups, but no parameter per log; {cure}", key=True)
        return
    if subject.static:
        cure = "a model without states reads tables; give it an input that tells them apart"
        yield places.fault(("per_log",), f"parameters per log are not for tables: {cure}", key=True)
        return
    if not names:
        yield places.fault(("per_log",), "names none; name some, or leave the key out", key=True)
    apart = _unlearnt(places.path.parent, groups, logs)
    known, seen = numbers_of(subject), set[str]()
    for k, name in enumerate(names):
        place, full = ("per_log", k), full_name(subject, name)
        if full not in known:
            yield places.fault(place, _unknown(subject, name))
            continue
        if full in seen:
            yield places.fault(place, f"{name} stands there twice; keep one")
        elif apart and full in subject.inestimable:
            text = f"{name} cannot be learnt while the filter runs, as it would be on {apart[0]}"
            yield places.fault(place, f"{text}; put {apart[0]} in a group with a log of estimation")
        seen.add(full)
    for k, name in enumerate(on_trial):
        if _whole(subject, name) <= seen:
            cure = "one per log is free in every hypothesis; name it in one place"
            yield places.fault(("candidates", k), f"{name} is per log too; {cure}")


def _unlearnt(folder: Path, groups: Groups, logs: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the sealed logs whose group has no estimation log."""
    group = group_of(folder, [*logs["estimation"], *logs["validation"]], groups)
    known = {group[folder / f] for f in logs["estimation"]}
    return [f for f in logs["validation"] if group[folder / f] not in known]


def _wrong_groups(places: Places, groups: Groups, listed: Sequence[str]) -> Iterator[Fault]:
    """Yield faults of groups."""
    folder, owner = places.path.parent, dict[str, str]()
    files = {os.path.realpath(folder / f) for f in listed}
    for group, members in groups.items():
        if group in listed:
            text = f'a group with the name of the log "{group}"; call it otherwise'
            yield places.fault(("groups", group), text, key=True)
        if not members:
            yield places.fault(("groups", group), f"{group} holds no log; name some, or leave it out", key=True)
        for k, name in enumerate(members):
            path, place = os.path.realpath(folder / name), ("groups", group, k)
            if path not in files:
                yield places.fault(place, f"{name} is not listed under logs{did_you_mean(name, listed)}")
            elif path in owner:
                twice = "twice" if owner[path] == group else f"in {owner[path]} too"
                yield places.fault(place, f"{name} stands {twice}; a log has one group, keep one")
            owner.setdefault(path, group)


def _unknown(subject: Subject, name: str) -> str:
    if name in subject.declared and not isinstance(subject.declared[name].default, bool):
        effect = name.partition(".")[0]
        return f"{name} acts nowhere in the model; an effect that the model lacks is a candidate, so leave {effect} out"
    known = numbers_of(subject)
    own = [n for n in known if n.startswith(f"{name}.")]
    short = [kind.name for kind in subject.sensors]
    hint = f"; name its parameters: {', '.join(own)}" if own else did_you_mean(name, [*known, *short])
    return f'no parameter "{name}" of the model or of its sensors{hint}'


def _whole(subject: Subject, name: str) -> set[str]:
    """Return the parameters of a candidate."""
    return {n for n in subject.declared if n.startswith(f"{name}.")} or {name}
