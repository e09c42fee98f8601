"""What counts as right. A result line holds a study's truth and the refiner's verdict; here they are compared.

Fractions are of the studies they speak of: right, in_set, wrong of the known ones; false_alarms of those with nothing;
outside_flagged, outside_misnamed of those from outside the catalogue. A study the refiner failed on (`failed`) stays in
the denominator and counts for none of them.
"""

from __future__ import annotations

import math
import re
import statistics
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

from tests.blind.truth_study import BASE, SENSORS

Line = dict[str, Any]

CONFIDENT = ("effect_found", "parameter_error", "sensor_error")
LARGEST_SET = 3


def wilson(hits: int, of: int, z: float = 1.959963984540054) -> tuple[float, float]:
    """Wilson's score interval for a fraction, 95 % unless `z` says otherwise; (0, 1) of nothing."""
    if of == 0:
        return 0.0, 1.0
    p, zz = hits / of, z * z / of
    middle, half = p + zz / 2.0, z * math.sqrt(p * (1.0 - p) / of + zz / (4.0 * of))
    return max(0.0, (middle - half) / (1.0 + zz)), min(1.0, (middle + half) / (1.0 + zz))


def named(line: Line) -> set[str]:
    """Names the verdict puts forward as what was added."""
    return {effect["name"] for effect in line["effects"]}


def expected_verdict(truth: Iterable[str], sensors: Iterable[str] = SENSORS) -> str:
    """Wrong base numbers are a parameter_error, sensor errors a sensor_error, all else an effect_found."""
    names = set(truth)
    if names <= set(BASE):
        return "parameter_error"
    return "sensor_error" if names <= set(sensors) else "effect_found"


def alternatives(line: Line) -> list[set[str]]:
    """The rivals of an `ambiguous` verdict, each a set of names: `a + b` are two effects together."""
    return [set(re.split(r"\s*[+,&]\s*", rival.strip())) for rival in line["rivals"]]


def share(hits: int, of: int) -> float | None:
    """A fraction to four digits; None of nothing."""
    return round(hits / of, 4) if of else None


def is_right(line: Line) -> bool:
    """Known: the verdict that fits the truth, and exactly its names: none too many, none missing."""
    return line["verdict"] == expected_verdict(line["truth"]) and named(line) == set(line["truth"])


def is_in_set(line: Line) -> bool:
    """Known: right; or `ambiguous`, and the truth is among at most three alternatives.

    An alternative is one entry of `rivals` (`a + b` names two effects together); if no single entry is the truth, the
    rivals and effects taken together may be at most three names, and hold all of the truth's.
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
    """Known: a confident verdict that names something the truth does not hold, alone or beside what it does."""
    return line["verdict"] in CONFIDENT and not named(line) <= set(line["truth"])


def is_false_alarm(line: Line) -> bool:
    """Nothing hidden: any verdict but `no_effect` and `unexplained`. `ambiguous` too says that something is there."""
    return line["verdict"] not in ("no_effect", "unexplained", "failed")


def is_flagged(line: Line) -> bool:
    """Outside: `unexplained` or `ambiguous`. (`no_effect` is neither flagged nor misnamed: it is missed.)"""
    return line["verdict"] in ("unexplained", "ambiguous")


def is_misnamed(line: Line) -> bool:
    """Outside: any confident verdict, as every name in it is another's."""
    return line["verdict"] in CONFIDENT


def excess_left(line: Line) -> float | None:
    """Share of the avoidable error that remains on the sealed run: the mean over the channels that have some.

    (after² − floor²)/(before² − floor²), not below 0, for channels with before > 2·floor; None if there are none. A
    study the refiner failed on has all of it left.
    """
    if line["verdict"] == "failed":
        return 1.0
    before, after, floor = line["error"]["before"], line["error"]["after"], line["noise_floor"]
    shares = [
        max(0.0, (after[c] ** 2 - floor[c] ** 2) / (before[c] ** 2 - floor[c] ** 2))
        for c in before
        if before[c] > 2.0 * floor[c]
    ]
    return statistics.fmean(shares) if shares else None


def covered(line: Line) -> list[bool]:
    """For each parameter of the truth that a confident verdict claims: does its 95 % interval hold the truth?"""
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
    """The figures `make blind` ends with: a count, then fractions (None where there is no study to count)."""
    figures = {name: hits / of if of else None for name, (hits, of) in counts(lines).items()}
    left = [e for line in _of(lines, "known") if (e := excess_left(line)) is not None]
    rounded = {name: None if value is None else round(value, 4) for name, value in figures.items()}
    coverage = rounded.pop("coverage")
    excess = round(statistics.median(left), 4) if left else None
    return {"studies": len(lines), **rounded, "excess_left": excess, "coverage": coverage}


def counts(lines: Sequence[Line]) -> dict[str, tuple[int, int]]:
    """Figure → (how many, of how many)."""
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
    """Confusion matrix, one row for each thing that was hidden, then the figures with counts and Wilson intervals."""
    rows: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    for line in lines:
        rows[line["kind"], label(line)][said(line)] += 1
    columns = ("right", "in set", "part", "wrong", "no_effect", "unexplained", "ambiguous", "failed")
    text = [f"{'hidden':48} {'n':>3}  " + "  ".join(f"{c:>{len(c)}}" for c in columns) + "  instead"]
    for kind in ("known", "nothing", "outside"):
        for (of_kind, hidden), heard in sorted(rows.items()):
            if of_kind != kind:
                continue
            cells = [sum(n for what, n in heard.items() if what.split(": ")[0] == c) for c in columns]
            instead = ", ".join(f"{w.split(': ')[1]} ×{n}" for w, n in sorted(heard.items()) if ": " in w)
            numbers = "  ".join(f"{n or '·':>{len(c)}}" for n, c in zip(cells, columns, strict=True))
            text.append(f"{hidden:48} {heard.total():3d}  {numbers}  {instead}".rstrip())
    text.append("")
    for name, (hits, of) in counts(lines).items():
        low, high = wilson(hits, of)
        share = f"{100 * hits / of:5.1f} %" if of else "    – "
        text.append(f"{name:18} {hits:4d} of {of:4d}  {share}  [{100 * low:5.1f}, {100 * high:5.1f}]")
    return "\n".join(text)


def label(line: Line) -> str:
    """What was hidden, in a row's words."""
    if line["kind"] == "nothing":
        return "nothing, disturbed" if line["disturbed"] else "nothing, clean"
    names = " + ".join(sorted(line["truth"]))
    return f"outside: {names}" if line["kind"] == "outside" else names


def said(line: Line) -> str:
    """The column a study falls in; what was named instead after a colon."""
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
