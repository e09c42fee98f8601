"""Scores of all suites: comparison of a study's truth with the refiner's verdict, from result lines.

Fractions refer to the studies of a kind: right, in_set, wrong to known studies; false_alarms, no_effect to studies
without effect; outside_flagged, outside_misnamed to studies with an effect outside the catalogue. A failed study stays
in the denominator and counts as no hit. Only a claim can be right. A part of the answer is neither right nor wrong,
unless it contains a name that is not in the truth; the nearest model names nothing.

Of mixed studies and the arm the parts of the truth count. A part is named if it is claimed, alone or as part of the
answer, or if one of at most three rivals contains it.
"""

import math
import re
import statistics
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from itertools import permutations
from typing import Any

from scipy.stats import binomtest

from tests.blind.truth import BASE, SENSORS

Line = dict[str, Any]
Counts = dict[str, tuple[int, int]]  # figure → number of hits, number of cases

LABORATORY, FIELD, MIXED, ARM, FMU = "laboratory", "field", "mixed", "arm", "fmu"
IN_PARTS = (MIXED, ARM)
KINDS = ("known", "nothing", "outside")
OUTCOMES = ("right", "in set", "part", "wrong", "no_effect", "unexplained", "ambiguous", "failed")
CONFIDENT = ("effect_found", "parameter_error", "sensor_error")
LARGEST_SET = 3
HALVED = 0.5  # of the sealed error of the arm's yardstick, from which friction has to be named


def wilson(hits: int, of: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a fraction; (0, 1) without cases."""
    if of == 0:
        return 0.0, 1.0
    interval = binomtest(hits, of).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def share_text(hits: int, of: int, width: int = 4) -> str:
    """Return hits, cases, their share and Wilson's 95 % interval."""
    low, high = wilson(hits, of)
    part = f"{100 * hits / of:5.1f} %" if of else "    – "
    return f" {hits:{width}d} of {of:{width}d}  {part}  [{100 * low:5.1f}, {100 * high:5.1f}]"


# -- a study -----------------------------------------------------------------------------------------------


def named(line: Line) -> set[str]:
    """Return the names of the effects in a verdict."""
    return {effect["name"] for effect in line["effects"]}


def grade(line: Line) -> str:
    """Return the grade `claimed`, `part`, `nearest` or ""; names under a confident verdict without one are claimed."""
    return line.get("grade") or ("claimed" if line["verdict"] in CONFIDENT else "")


def put_forward(line: Line) -> set[str]:
    """Return the names that a verdict claims, wholly (`claimed`) or in part (`part`)."""
    return named(line) if grade(line) in ("claimed", "part") else set()


def expected_verdict(line: Line) -> str:
    """Return the verdict for the truth: base parameters alone, sensor errors alone, or effects."""
    names = set(line["truth"])
    if names <= set(BASE):
        return "parameter_error"
    return "sensor_error" if names <= {*SENSORS, *line.get("sensors", ())} else "effect_found"


def alternatives(line: Line) -> list[set[str]]:
    """Return the rivals of an `ambiguous` verdict as sets of names: `a + b` are two effects together."""
    return [set(re.split(r"\s*[+,&]\s*", rival.strip())) for rival in line["rivals"]]


def replaceable(line: Line) -> list[tuple[str, str]]:
    """Return pairs of a claimed name and of an effect that is `not_excluded` in its place, or acts `alike`."""
    special = [(x["in_place_of"], x["name"]) for x in line.get("not_excluded", ())]
    alike = [(name, other) for group in line.get("alike", ()) for name, other in permutations(group, 2)]
    return special + [(name, other) for name, other in alike if name in named(line)]


def is_right(line: Line) -> bool:
    """Return whether a known study has the expected verdict and claims exactly the names of the truth.

    Of a study in parts, whether exactly the true parts are named.
    """
    if line.get("suite") in IN_PARTS:
        return named_parts(line) == parts(line) and not wrong_parts(line)
    fits = line["verdict"] == expected_verdict(line)
    return fits and grade(line) == "claimed" and named(line) == set(line["truth"])


def is_in_set(line: Line) -> bool:
    """Return whether a known study is right, or ambiguous with the truth in a small set.

    An alternative is an entry of `rivals` (`a + b` means both effects). The truth is one of at most three alternatives,
    or within at most three names of all alternatives together. A claim in whose place the verdict leaves the truth open
    (`not_excluded`, `alike`) is in the set, too.
    """
    truth, sets = set(line["truth"]), alternatives(line)
    left_open = [(named(line) - {claimed}) | {other} for claimed, other in replaceable(line)]
    if is_right(line) or (grade(line) == "claimed" and truth in left_open):
        return True
    if line["verdict"] != "ambiguous" or not put_forward(line) <= truth:
        return False
    together = set().union(named(line), *sets)
    return (truth in sets and len(sets) <= LARGEST_SET) or (truth <= together and len(together) <= LARGEST_SET)


def is_wrong(line: Line) -> bool:
    """Return whether a study gets a name, claimed wholly or in part, that is not in the truth (`wrong_parts`)."""
    return bool(wrong_parts(line))


def is_misnamed(line: Line) -> bool:
    """Return whether a study gets any name that is not in the truth."""
    return not put_forward(line) <= set(line["truth"])


def is_false_alarm(line: Line) -> bool:
    """Return whether a study without effect gets a verdict other than `no_effect` and `unexplained`, or a name."""
    return line["verdict"] not in ("no_effect", "unexplained", "failed") or bool(put_forward(line))


def is_flagged(line: Line) -> bool:
    """Return whether a study with an effect outside the catalogue is `unexplained` or `ambiguous`, without a name."""
    return line["verdict"] in ("unexplained", "ambiguous") and not put_forward(line)


def claims(line: Line) -> list[bool]:
    """Return for each claimed true parameter whether its 95 % interval contains the true value."""
    if line["verdict"] not in CONFIDENT or grade(line) != "claimed":
        return []
    found = []
    for effect in line["effects"]:
        truth = line["truth"].get(effect["name"], {})
        for name in effect["parameters"].keys() & truth.keys():
            low, high = effect["parameters"][name].get("ci95") or (math.inf, -math.inf)
            found.append(low <= truth[name] <= high)
    return found


def excess_left(line: Line) -> float | None:
    """Return the share of the avoidable error left on the sealed log, mean over channels; 1 for a failed study.

    (after² − floor²)/(before² − floor²), not below 0, for channels with a floor and before > 2·floor; None without such
    channels. Channels with a floor above their own spread have none.
    """
    if line["verdict"] == "failed":
        return 1.0
    before, after = (line["error"][stage]["validation"] for stage in ("before", "after"))
    floor = line["noise_floor"]
    shares = [
        max(0.0, (after[c] ** 2 - floor[c] ** 2) / (before[c] ** 2 - floor[c] ** 2))
        for c in before
        if c in floor and before[c] > 2.0 * floor[c]
    ]
    return statistics.fmean(shares) if shares else None


def delivered(line: Line) -> Any:
    """Return the errors of the claim on the sealed log, else those of the nearest model."""
    stage = "nearest" if grade(line) != "claimed" and "nearest" in line["error"] else "after"
    return line["error"][stage]["validation"]


def sealed_ratio(line: Line) -> float | None:
    """Return the mean ratio of the sealed error of what is delivered to the true model's error.

    A failed study has ratio ∞, one without a channel of both None.
    """
    if line["verdict"] == "failed":
        return math.inf
    error, true = delivered(line), line["error_true"]
    ratios = [error[c] / true[c] for c in true if c in error]
    return statistics.fmean(ratios) if ratios else None


def parts(line: Line) -> set[str]:
    """Return the true effects of a study without strangers (effects outside the catalogue)."""
    return set(line["truth"]) - set(line.get("strangers", ()))


def named_parts(line: Line) -> set[str]:
    """Return the true effects that a verdict claims, wholly or in part, or that one of a few rivals contains."""
    sets = alternatives(line)
    shared = set().union(*sets) if len(sets) <= LARGEST_SET else set()
    return parts(line) & (put_forward(line) | shared)


def wrong_parts(line: Line) -> set[str]:
    """Return names that a verdict claims, wholly or in part, and that are not true effects of the catalogue.

    A name in whose place the verdict leaves the true effect open is not wrong.
    """
    open_cases = {claimed for claimed, other in replaceable(line) if other in parts(line)}
    return put_forward(line) - parts(line) - open_cases


def is_due(line: Line) -> bool:
    """Return whether friction in a least-squares fit of the arm at least halves a channel's error on the sealed log."""
    errors = line.get("yardstick")
    return not errors or any(w <= HALVED * o for o, w in zip(errors["without"], errors["with"], strict=True))


def outcome(line: Line) -> str:
    """Return the outcome of a study: a word of `OUTCOMES`."""
    if line["kind"] == "known":
        for word, holds in (("right", is_right), ("in set", is_in_set)):
            if holds(line):
                return word
    if put_forward(line):
        return "wrong" if line["kind"] != "known" or is_wrong(line) else "part"
    return str(line["verdict"])


# -- many studies ------------------------------------------------------------------------------------------


def counts(suite: str, lines: Iterable[Line]) -> Counts:
    """Return the counted figures of a suite."""
    lines = list(lines)
    known, nothing, outside = ([line for line in lines if line["kind"] == kind] for kind in KINDS)

    def count(holds: Callable[[Line], Any], of: Sequence[Line]) -> tuple[int, int]:
        return sum(bool(holds(line)) for line in of), len(of)

    if suite in IN_PARTS:
        due = [line for line in known if is_due(line)]
        return {
            "all_parts_named": count(lambda line: named_parts(line) == parts(line), due),
            "parts_named": (sum(len(named_parts(line)) for line in due), sum(len(parts(line)) for line in due)),
            "wrong_parts": (sum(len(wrong_parts(line)) for line in lines), sum(len(put_forward(x)) for x in lines)),
            "studies_with_wrong_parts": count(wrong_parts, lines),
            "false_alarms": count(is_false_alarm, nothing),
            "coverage": coverage(lines),
        }
    found = {
        "right": count(is_right, known),
        "in_set": count(is_in_set, known),
        "wrong": count(is_wrong, known),
        "false_alarms": count(is_false_alarm, nothing),
        "no_effect": count(lambda line: line["verdict"] == "no_effect", nothing),
        "outside_flagged": count(is_flagged, outside),
        "outside_misnamed": count(is_misnamed, outside),
        "coverage": coverage(known),
    }
    if suite == LABORATORY:
        del found["no_effect"]
    return found


def coverage(lines: Iterable[Line]) -> tuple[int, int]:
    """Return how many intervals of claims hold the truth, and how many there are."""
    hits = [hit for line in lines for hit in claims(line)]
    return sum(hits), len(hits)


def summary(suite: str, lines: Sequence[Line]) -> dict[str, Any]:
    """Return the figures of a suite in the last line of the output; None for figures without cases."""
    shares = {name: round(hits / of, 4) if of else None for name, (hits, of) in counts(suite, lines).items()}
    found: dict[str, Any] = {"studies": len(lines)} | shares
    known = [line for line in lines if line["kind"] == "known"]
    if suite == LABORATORY:
        left = [e for line in known if (e := excess_left(line)) is not None]
        covered = found.pop("coverage")
        found |= {"excess_left": round(statistics.median(left), 4) if left else None, "coverage": covered}
    if suite in (FIELD, FMU):
        ratios = sorted(ratio for line in known if (ratio := sealed_ratio(line)) is not None)
        seconds = sorted(line["seconds"] for line in lines)
        found |= {"sealed_ratio_median": _ranked(ratios, 0.5), "sealed_ratio_90": _ranked(ratios, 0.9)}
        found |= {"seconds_median": _ranked(seconds, 0.5), "seconds_95": _ranked(seconds, 0.95)}
    return found


def _ranked(values: Sequence[float], part: float) -> float | None:
    """Return the smallest value not exceeded by `part` of all values; None without values or if infinite."""
    value = values[max(0, math.ceil(part * len(values)) - 1)] if values else math.inf
    return round(value, 4) if math.isfinite(value) else None


# -- texts -------------------------------------------------------------------------------------------------


def text_of(line: Line) -> str:
    """Return plant, kind and hidden names of a study, its outcome, and the names put forward."""
    about = [str(line[key]) for key in ("plant", "way", "version", "size", "kind") if line.get(key)]
    found = " + ".join(sorted(put_forward(line)) or line["rivals"])
    return f"{' '.join(about)}: {' + '.join(sorted(line['truth']))} → {outcome(line)}: {found}"


def table(suite: str, lines: Sequence[Line]) -> str:
    """Return a table of outcomes by plant and kind and by hidden name, then the figures with 95 % intervals."""
    rows: dict[str, list[str]] = defaultdict(list)
    for line in lines:
        plant = " ".join(str(line[key]) for key in ("plant", "way") if line.get(key)) or "craft"
        for row in (f"{plant}, {line['kind']} {line.get('size', '')}", *line["truth"]):
            rows[row].append(outcome(line))
    text = [f"{suite:48} {'n':>3}  {'  '.join(OUTCOMES)}"]
    for name, words in sorted(rows.items()):
        cells = "  ".join(f"{words.count(c) or '·':>{len(c)}}" for c in OUTCOMES)
        text.append(f"{name:48} {len(words):3d}  {cells}")
    figures = [f"{name:25}{share_text(*pair)}" for name, pair in counts(suite, lines).items()]
    return "\n".join([*text, "", *figures])
