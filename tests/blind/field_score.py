"""Scores of the field half, for a refiner that grades its statements: claimed, part, nearest.

Fractions refer to the studies of a kind, failed studies included, as in `score`. Only a claim can be right. A part of
the answer is neither right nor wrong, unless it contains a name that is not in the truth; the nearest model names
nothing.
"""

from __future__ import annotations

import math
import statistics
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

from tests.blind.score import (
    CONFIDENT,
    LARGEST_SET,
    Line,
    alternatives,
    covered,
    expected_verdict,
    left_open,
    named,
    share,
    wilson,
)


def grade(line: Line) -> str:
    """Return the grade `claimed`, `part`, `nearest` or "".

    Without a grade, names under a confident verdict count as claimed.
    """
    given = line.get("grade")
    return str(given) if given else "claimed" if line["verdict"] in CONFIDENT else ""


def put_forward(line: Line) -> set[str]:
    """Return the names that a verdict claims, wholly (`claimed`) or in part (`part`)."""
    return named(line) if grade(line) in ("claimed", "part") else set()


def is_right(line: Line) -> bool:
    """Return whether a known study has the expected verdict and claims exactly the names of the truth."""
    fits = line["verdict"] == expected_verdict(line["truth"], line["sensors"])
    return fits and grade(line) == "claimed" and named(line) == set(line["truth"])


def is_in_set(line: Line) -> bool:
    """Return whether a known study is right, or ambiguous with the truth in a small set.

    The truth is one of at most three alternatives, or within at most three names of all alternatives together. A claim
    in whose place the verdict leaves the truth open (`not_excluded`, `alike`) is in the set, too.
    """
    if is_right(line) or (grade(line) == "claimed" and set(line["truth"]) in left_open(line)):
        return True
    if line["verdict"] != "ambiguous" or not put_forward(line) <= set(line["truth"]):
        return False
    truth, sets = set(line["truth"]), alternatives(line)
    if truth in sets and len(sets) <= LARGEST_SET:
        return True
    together = set().union(named(line), *sets)
    return truth <= together and len(together) <= LARGEST_SET


def is_wrong(line: Line) -> bool:
    """Return whether a known study gets a name, claimed wholly or in part, that is not in the truth.

    A name in whose place the verdict leaves the true effect open is not wrong.
    """
    truth = set(line["truth"])
    return not put_forward(line) <= truth and not any(names <= truth for names in left_open(line))


def is_false_alarm(line: Line) -> bool:
    """Return whether a study without effect gets a verdict other than `no_effect` and `unexplained`, or a name."""
    return line["verdict"] not in ("no_effect", "unexplained", "failed") or bool(put_forward(line))


def is_misnamed(line: Line) -> bool:
    """Return whether a study with an effect outside the catalogue gets any name but that of the effect."""
    return not put_forward(line) <= set(line["truth"])


def is_flagged(line: Line) -> bool:
    """Return whether a study with an effect outside the catalogue is `unexplained` or `ambiguous`, without a name."""
    return line["verdict"] in ("unexplained", "ambiguous") and not put_forward(line)


def claims(line: Line) -> list[bool]:
    """Return for each claimed true parameter whether its 95 % interval contains the true value."""
    return covered(line) if grade(line) == "claimed" else []


def sealed_ratio(line: Line) -> float | None:
    """Return the mean ratio of the sealed error of the claim, else of the nearest model, to the true model's error.

    A failed study has ratio ∞, one without a channel of both None.
    """
    if line["verdict"] == "failed":
        return math.inf
    stage = "nearest" if grade(line) != "claimed" and "nearest" in line["error"] else "after"
    error, true = line["error"][stage], line["error_true"]
    ratios = [error[c] / true[c] for c in true if c in error]
    return statistics.fmean(ratios) if ratios else None


def counts(lines: Sequence[Line]) -> dict[str, tuple[int, int]]:
    """Return figure → (number of hits, number of cases)."""
    known, nothing, outside = ([line for line in lines if line["kind"] == k] for k in ("known", "nothing", "outside"))

    def held(chosen: Iterable[Line]) -> tuple[int, int]:
        hits = [hit for line in chosen for hit in claims(line)]
        return sum(hits), len(hits)

    return {
        "right": (sum(map(is_right, known)), len(known)),
        "in_set": (sum(map(is_in_set, known)), len(known)),
        "wrong": (sum(map(is_wrong, known)), len(known)),
        "false_alarms": (sum(map(is_false_alarm, nothing)), len(nothing)),
        "no_effect": (sum(line["verdict"] == "no_effect" for line in nothing), len(nothing)),
        "outside_flagged": (sum(map(is_flagged, outside)), len(outside)),
        "outside_misnamed": (sum(map(is_misnamed, outside)), len(outside)),
        "coverage": held(known),
        "coverage_disturbed_small": held(line for line in known if line["disturbance"] == "small"),
        "coverage_disturbed_large": held(line for line in known if line["disturbance"] == "large"),
    }


def summary(lines: Sequence[Line]) -> dict[str, Any]:
    """Return the entry `field` in the last line of the output; None for figures without cases."""
    known = [line for line in lines if line["kind"] == "known"]
    ratios = sorted(ratio for line in known if (ratio := sealed_ratio(line)) is not None)
    seconds = sorted(line["seconds"] for line in lines)
    by_number = {
        str(number): {"studies": len(chosen)} | shares(counts(chosen), ("right", "in_set", "wrong"))
        for number in sorted({len(line["truth"]) for line in known})
        if (chosen := [line for line in known if len(line["truth"]) == number])
    }
    return {
        "studies": len(lines),
        **shares(counts(lines)),
        "sealed_ratio_median": _ranked(ratios, 0.5),
        "sealed_ratio_90": _ranked(ratios, 0.9),
        "by_effects": by_number,
        "seconds_median": _ranked(seconds, 0.5),
        "seconds_95": _ranked(seconds, 0.95),
    }


def shares(counted: dict[str, tuple[int, int]], names: Sequence[str] = ()) -> dict[str, float | None]:
    """Return figure → share of its cases, of all figures or of those named."""
    return {name: share(*counted[name]) for name in names or counted}


def _ranked(values: Sequence[float], part: float) -> float | None:
    """Return the smallest value not exceeded by `part` of all values; None without values or if infinite."""
    if not values:
        return None
    value = values[max(0, math.ceil(part * len(values)) - 1)]
    return round(value, 4) if math.isfinite(value) else None


def label(line: Line) -> str:
    """Return the plant and the hidden names as label of a row."""
    names = " + ".join(sorted(line["truth"])) or "nothing"
    return f"{line['plant']}: {'outside: ' if line['kind'] == 'outside' else ''}{names}"


def outcome_text(line: Line) -> str:
    """Return the outcome of a study as a word; wrong names follow after a colon."""
    names = " + ".join(sorted(put_forward(line)))
    if line["kind"] == "known":
        word = "right" if is_right(line) else "in set" if is_in_set(line) else "wrong" if is_wrong(line) else ""
        return f"wrong: {names}" if word == "wrong" else word or (f"part: {names}" if names else str(line["verdict"]))
    return f"wrong: {names}" if names else str(line["verdict"])


def table(lines: Sequence[Line]) -> str:
    """Return the outcomes by plant and by hidden effect, then the figures."""
    rows: dict[tuple[str, str], list[Line]] = defaultdict(list)
    for line in lines:
        rows["", f"{line['plant']}, {line['kind']}"].append(line)
        for name in line["truth"]:
            rows[line["kind"], f"{line['plant']}: {name}"].append(line)
    columns = ("right", "in set", "part", "wrong", "no_effect", "unexplained", "ambiguous", "failed")
    text = [f"{'field':48} {'n':>3}  " + "  ".join(columns)]
    for (kind, name), chosen in sorted(rows.items()):
        outcomes = [outcome_text(line).split(": ")[0] for line in chosen]
        cells = "  ".join(f"{outcomes.count(c) or '·':>{len(c)}}" for c in columns)
        text.append(f"{'outside: ' if kind == 'outside' else ''}{name}".ljust(48) + f" {len(chosen):3d}  {cells}")
    text.append("")
    for name, (hits, of) in counts(lines).items():
        low, high = wilson(hits, of)
        part = f"{100 * hits / of:5.1f} %" if of else "    – "
        text.append(f"{name:25} {hits:4d} of {of:4d}  {part}  [{100 * low:5.1f}, {100 * high:5.1f}]")
    return "\n".join(text)
