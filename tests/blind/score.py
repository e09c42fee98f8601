"""Scores of the laboratory half: comparison of a study's truth with the refiner's verdict, from result lines.

Fractions refer to the studies of a kind: right, in_set, wrong to known studies; false_alarms to studies without effect;
outside_flagged, outside_misnamed to studies with an effect outside the catalogue. A failed study stays in the
denominator and counts as no hit.
"""

from __future__ import annotations

import math
import re
import statistics
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from itertools import permutations
from typing import Any

from tests.blind.truth_study import BASE, SENSORS

Line = dict[str, Any]

CONFIDENT = ("effect_found", "parameter_error", "sensor_error")
LARGEST_SET = 3


def wilson(hits: int, of: int, z: float = 1.959963984540054) -> tuple[float, float]:
    """Return Wilson's score interval of a fraction, by default 95 %; (0, 1) without cases."""
    if of == 0:
        return 0.0, 1.0
    p, zz = hits / of, z * z / of
    middle, half = p + zz / 2.0, z * math.sqrt(p * (1.0 - p) / of + zz / (4.0 * of))
    return max(0.0, (middle - half) / (1.0 + zz)), min(1.0, (middle + half) / (1.0 + zz))


def named(line: Line) -> set[str]:
    """Return the names of the effects in a verdict."""
    return {effect["name"] for effect in line["effects"]}


def expected_verdict(truth: Iterable[str], sensors: Iterable[str] = SENSORS) -> str:
    """Return the verdict for a truth.

    Base parameters alone give parameter_error, sensor errors alone sensor_error, all else effect_found.
    """
    names = set(truth)
    if names <= set(BASE):
        return "parameter_error"
    return "sensor_error" if names <= set(sensors) else "effect_found"


def alternatives(line: Line) -> list[set[str]]:
    """Return the rivals of an `ambiguous` verdict as sets of names: `a + b` are two effects together."""
    return [set(re.split(r"\s*[+,&]\s*", rival.strip())) for rival in line["rivals"]]


def left_open(line: Line) -> list[set[str]]:
    """Return sets of the claimed names, with one replaced by an effect that the verdict leaves open in its place."""
    return [(named(line) - {claimed}) | {other} for claimed, other in replaceable(line)]


def replaceable(line: Line) -> list[tuple[str, str]]:
    """Return pairs of a claimed name and of an effect that is `not_excluded` in its place, or acts `alike`."""
    special = [(x["in_place_of"], x["name"]) for x in line.get("not_excluded", ())]
    alike = [(name, other) for group in line.get("alike", ()) for name, other in permutations(group, 2)]
    return special + [(name, other) for name, other in alike if name in named(line)]


def share(hits: int, of: int) -> float | None:
    """Return a fraction with four digits; None without cases."""
    return round(hits / of, 4) if of else None


def is_right(line: Line) -> bool:
    """Return whether a known study has the expected verdict and exactly the names of the truth."""
    return line["verdict"] == expected_verdict(line["truth"]) and named(line) == set(line["truth"])


def is_in_set(line: Line) -> bool:
    """Return whether a known study is right, or ambiguous with the truth in a small set.

    An alternative is an entry of `rivals` (`a + b` means both effects). The truth is one of at most three alternatives,
    or within at most three names of all rivals and effects together.
    """
    if is_right(line):
        return True
    if line["verdict"] != "ambiguous":
        return False
    truth = set(line["truth"])
    sets = alternatives(line)
    if truth in sets and len(sets) <= LARGEST_SET:
        return True
    together = set().union(named(line), *sets)
    return truth <= together and len(together) <= LARGEST_SET


def is_wrong(line: Line) -> bool:
    """Return whether a known study has a confident verdict with a name that is not in the truth."""
    return line["verdict"] in CONFIDENT and not named(line) <= set(line["truth"])


def is_false_alarm(line: Line) -> bool:
    """Return whether a study without effect has a verdict other than `no_effect` and `unexplained`.

    `ambiguous` counts as false alarm, since it claims an effect.
    """
    return line["verdict"] not in ("no_effect", "unexplained", "failed")


def is_flagged(line: Line) -> bool:
    """Return whether a study with an effect outside the catalogue is `unexplained` or `ambiguous`.

    `no_effect` is neither flagged nor misnamed, but missed.
    """
    return line["verdict"] in ("unexplained", "ambiguous")


def is_misnamed(line: Line) -> bool:
    """Return whether a study with an effect outside the catalogue has a confident verdict; any name is wrong."""
    return line["verdict"] in CONFIDENT


def excess_left(line: Line) -> float | None:
    """Return the share of the avoidable error left on the sealed log, mean over channels; 1 for a failed study.

    (after² − floor²)/(before² − floor²), not below 0, for channels with a floor and before > 2·floor; None without such
    channels. Channels with a floor above their own spread have none.
    """
    if line["verdict"] == "failed":
        return 1.0
    before, after, floor = line["error"]["before"], line["error"]["after"], line["noise_floor"]
    shares = [
        max(0.0, (after[c] ** 2 - floor[c] ** 2) / (before[c] ** 2 - floor[c] ** 2))
        for c in before
        if c in floor and before[c] > 2.0 * floor[c]
    ]
    return statistics.fmean(shares) if shares else None


def covered(line: Line) -> list[bool]:
    """Return for each true parameter in a confident verdict whether its 95 % interval contains the true value."""
    if line["verdict"] not in CONFIDENT:
        return []
    found = []
    for effect in line["effects"]:
        truth = line["truth"].get(effect["name"], {})
        for name, claim in effect["parameters"].items():
            if name in truth:
                low, high = claim.get("ci95") or (math.inf, -math.inf)
                found.append(low <= truth[name] <= high)
    return found


def summary(lines: Sequence[Line]) -> dict[str, Any]:
    """Return the figures at the end of `make blind`: a count, then fractions (None without cases)."""
    figures = {name: hits / of if of else None for name, (hits, of) in counts(lines).items()}
    left = [e for line in _of(lines, "known") if (e := excess_left(line)) is not None]
    rounded = {name: None if value is None else round(value, 4) for name, value in figures.items()}
    coverage = rounded.pop("coverage")
    excess = round(statistics.median(left), 4) if left else None
    return {"studies": len(lines), **rounded, "excess_left": excess, "coverage": coverage}


def counts(lines: Sequence[Line]) -> dict[str, tuple[int, int]]:
    """Return figure → (number of hits, number of cases)."""
    known, nothing, outside = (_of(lines, kind) for kind in ("known", "nothing", "outside"))
    claims = [hit for line in known for hit in covered(line)]
    return {
        "right": (sum(map(is_right, known)), len(known)),
        "in_set": (sum(map(is_in_set, known)), len(known)),
        "wrong": (sum(map(is_wrong, known)), len(known)),
        "false_alarms": (sum(map(is_false_alarm, nothing)), len(nothing)),
        "outside_flagged": (sum(map(is_flagged, outside)), len(outside)),
        "outside_misnamed": (sum(map(is_misnamed, outside)), len(outside)),
        "coverage": (sum(claims), len(claims)),
    }


def _of(lines: Sequence[Line], kind: str) -> list[Line]:
    return [line for line in lines if line["kind"] == kind]


def table(lines: Sequence[Line]) -> str:
    """Return the confusion matrix with a row per hidden effect, then the figures with counts and Wilson intervals."""
    rows: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    for line in lines:
        rows[line["kind"], label(line)][outcome_text(line)] += 1
    columns = ("right", "in set", "part", "wrong", "no_effect", "unexplained", "ambiguous", "failed")
    text = [f"{'hidden':48} {'n':>3}  " + "  ".join(f"{c:>{len(c)}}" for c in columns) + "  instead"]
    for kind in ("known", "nothing", "outside"):
        for (of_kind, hidden), outcomes in sorted(rows.items()):
            if of_kind != kind:
                continue
            cells = [sum(n for what, n in outcomes.items() if what.split(": ")[0] == c) for c in columns]
            instead = ", ".join(f"{w.split(': ')[1]} ×{n}" for w, n in sorted(outcomes.items()) if ": " in w)
            numbers = "  ".join(f"{n or '·':>{len(c)}}" for n, c in zip(cells, columns, strict=True))
            text.append(f"{hidden:48} {outcomes.total():3d}  {numbers}  {instead}".rstrip())
    text.append("")
    for name, (hits, of) in counts(lines).items():
        low, high = wilson(hits, of)
        share = f"{100 * hits / of:5.1f} %" if of else "    – "
        text.append(f"{name:18} {hits:4d} of {of:4d}  {share}  [{100 * low:5.1f}, {100 * high:5.1f}]")
    return "\n".join(text)


def label(line: Line) -> str:
    """Return the hidden effects as label of a row."""
    if line["kind"] == "nothing":
        return "nothing, disturbed" if line["disturbed"] else "nothing, clean"
    names = " + ".join(sorted(line["truth"]))
    return f"outside: {names}" if line["kind"] == "outside" else names


def outcome_text(line: Line) -> str:
    """Return the outcome of a study, a column of the table; wrong names follow after a colon."""
    verdict = line["verdict"]
    names = " + ".join(sorted(named(line))) or "?"
    if line["kind"] == "known":
        if is_right(line):
            return "right"
        if is_in_set(line):
            return "in set"
        if is_wrong(line):
            return f"wrong: {names}"
        if verdict in CONFIDENT:
            return f"part: {names}"
    elif verdict in CONFIDENT:
        return f"wrong: {names}"
    if verdict == "ambiguous":
        return "ambiguous: " + " | ".join(line["rivals"])
    return str(verdict)
