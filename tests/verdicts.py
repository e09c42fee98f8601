"""Whether a refine.json agrees with itself: its sentence with its numbers, its verdict with its grade and its files."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from cosim.base.text import MOST_NAMED, join_names, percent, plain
from cosim.refinement.decision.sentences import IN_PART
from cosim.residuals.residual_statistics import remaining_excess

CLAIMS = {"effect_found", "parameter_error", "sensor_error"}
FILES = {"claimed": ("model.yaml", "plant.fmu"), "other": ("model.yaml", "plant.fmu", "nearest.yaml", "nearest.fmu")}
NOISE = 0.03  # of the excess error: what replays by the kernel, as the verdict has them, and through the FMU may differ
PART = 0.1
Record = Mapping[str, Any]


ESTIMATE = r"(\w+) = ([-\d.e+]+) ± ([-\d.e+]+)"


def contradictions(record: Record, folder: Path | None = None) -> list[str]:
    """Return all contradictions within a record, and with the files beside it."""
    rules = (
        _names, _intervals, _estimates, _grade, _rivals, _nearest, _share, _left, _misses, _floors, _sealed, _improved,
    )  # fmt: skip
    said = [text for rule in rules for text in rule(record)]
    return said + (list(_files(record, folder)) if folder is not None else [])


def _claimed(record: Record) -> list[str]:
    return [e["name"] for e in record["effects"]]


def _names(record: Record) -> Iterator[str]:
    """Yield contradictions of claimed names with hidden names, ranking and sentence."""
    claimed, said = _claimed(record), record["sentence"]
    if both := set(claimed) & set(record["hidden"]):
        yield f"claimed, and not to be seen: {sorted(both)}"
    ranked = [set(c["names"]) for c in record["candidates"] if c["why"] == "claimed"]
    if ranked != ([set(claimed)] if claimed and record["verdict"] != "ambiguous" else []):
        yield f"claimed {claimed}, in the ranking {ranked}"
    if record["verdict"] in CLAIMS:
        yield from (f"{name} is claimed and not in the sentence" for name in claimed if name not in said)
    if record["verdict"] == "no_effect":
        yield from (
            f"{name} would not have shown, which the sentence does not say" for name in _untold(record["hidden"], said)
        )


def _untold(names: list[str], said: str) -> list[str]:
    """Return names missing in a sentence; of more than three, it must contain the first and their number."""
    if len(names) > MOST_NAMED and not re.search(rf"\b{len(names)} \w+: ", said):
        return names
    return [name for name in names[:MOST_NAMED] if name not in said]


def _intervals(record: Record) -> Iterator[str]:
    """Yield estimates that are not in the middle of their interval, unless the sentence gives its limits."""
    for entry in record["effects"]:
        for name, p in entry["parameters"].items():
            low, high = p["ci95"]
            if _has_limits(record, name) and low <= p["value"] <= high:
                continue
            if not abs(p["value"] - 0.5 * (low + high)) <= 1e-6 * (high - low) + 1e-12 * abs(p["value"]):
                yield f"{entry['name']}.{name} is {p['value']}, and its interval {p['ci95']}"


def _has_limits(record: Record, name: str) -> bool:
    """Return True if the sentence gives the limits of a parameter in place of its value."""
    return re.search(rf"\b{name} (at most|at least|between) ", record["sentence"]) is not None


def _estimates(record: Record) -> Iterator[str]:
    """Every `name = value ± half` of the sentence is an estimate, rounded; of a claim each estimate is told."""
    said = {(name, half): float(value) for name, value, half in re.findall(ESTIMATE, record["sentence"])}
    known: set[tuple[str, str]] = set()
    for entry in record["effects"]:
        for name, p in entry["parameters"].items():
            half = 0.5 * (p["ci95"][1] - p["ci95"][0])
            ways = {(own, f"{half:.2g}") for own in ((name, entry["name"]) if name == "value" else (name,))}
            known |= ways
            told = [said[way] for way in ways & said.keys()]
            untold = not told and f"{name} not identified" not in record["sentence"] and not _has_limits(record, name)
            if record["verdict"] in CLAIMS and untold:
                yield f"the sentence does not tell {entry['name']}.{name} ± {half:.2g}"
            if any(abs(value - p["value"]) > max(0.1 * half, 1e-11 * abs(value)) for value in told):
                yield f"the sentence has {told} for {entry['name']}.{name} = {p['value']} ± {half:.2g}"
    if strange := said.keys() - known:
        yield f"the sentence has {sorted(strange)}, the record {sorted(known)}"


def _grade(record: Record) -> Iterator[str]:
    verdict, grade, claimed = record["verdict"], record["grade"], _claimed(record)
    if (grade in ("claimed", "part")) != (verdict in CLAIMS or (verdict == "ambiguous" and bool(claimed))):
        yield f"{verdict} is {grade}"
    if verdict in CLAIMS and not claimed:
        yield f"{verdict}, and nothing is claimed"
    if verdict in ("no_effect", "unexplained") and claimed:
        yield f"{verdict}, and {claimed} is claimed"
    if verdict != "ambiguous" and (grade == "part") != (IN_PART in record["sentence"]):
        yield f"the grade is {grade}, the sentence {record['sentence']!r}"
    changed = any(
        record["error"]["before"][part] != record["error"]["after"][part] for part in record["error"]["before"]
    )
    if changed and not claimed and verdict != "ambiguous":
        yield "nothing is claimed, and the error after is another than before"


def _rivals(record: Record) -> Iterator[str]:
    """Yield contradictions of rivals with verdict, sentence and experiment."""
    rivals, said = record["rivals"], record["sentence"]
    if (record["verdict"] == "ambiguous") != bool(rivals):
        yield f"{record['verdict']} with rivals {rivals}"
    if record["verdict"] != "ambiguous":
        return
    if len(rivals) < 2 or not record["experiment"] or record["experiment"] not in said:
        yield f"rivals {rivals}, experiment {record['experiment']!r}"
    counted = re.search(r"none of (\d+) effects", said)
    is_of_fits = counted is None and "the one effect" not in said
    for c in record["candidates"]:
        if c["why"].startswith("a rival: ") != (is_of_fits and " + ".join(c["names"]) in rivals):
            yield f"{c['names']} is {c['why']!r} beside the rivals {rivals}"
    effects = len([name for name in rivals if name != "no_effect"])
    if counted is not None and int(counted[1]) != effects:
        yield f"{counted[0]} in the sentence, {effects} in the record"
    if is_of_fits:
        yield from (f"the rival {name} is not in the sentence" for name in _untold(rivals, said))


def _nearest(record: Record) -> Iterator[str]:
    """Yield contradictions of an incomplete claim with its nearest model and the sentence."""
    error, held = (
        record["error"],
        re.search(r"nearest\.yaml predicts held-out logs best; it (.*?)\.(?: |$)", record["sentence"]),
    )
    if (record["grade"] == "claimed") != (error.get("nearest") is None) or (record["grade"] == "claimed") != (
        held is None
    ):
        yield f"the grade is {record['grade']}, nearest {error.get('nearest')}, in the sentence {held and held[0]!r}"
    if held is None or error.get("nearest") is None:
        return
    names = record["nearest"]
    before = re.search(r"Best candidates, not confirmed: (.*?)\.", record["sentence"])
    contents = before[1] if before and held[1] == "contains them" else held[1].removeprefix("contains ")
    contents = "" if held[1].startswith("is the model") else re.sub(r"^\d+ candidates: ", "", contents)
    if join_names(names) != contents:
        yield f"nearest.yaml contains {names}, the sentence says it {held[1]}"
    if held[1] == "is the model as it was" and error["nearest"] != error["before"]:
        yield "nearest.yaml is the model as it was, and its error another"


def _share(record: Record) -> Iterator[str]:
    """Where something acts, on what it depends and how much that takes away."""
    residual, said = record["residual"], record["sentence"]
    if "Something outside the catalogue" in said or "A disturbance acts" in said:
        if f"acts on {residual['equation']}" not in said:
            yield f"the misfit is in {residual['equation']}, the sentence says {said!r}"
        for signal in residual["signals"][:1]:
            if signal != "1" and f"depends on {signal}" not in said:
                yield f"it depends on {signal}, the sentence says {said!r}"
    found = re.search(r"This dependence explains ((?:less than |more than )?[\d.]+\u00a0%) of what is missing", said)
    if found is not None and found[1] != percent(residual["share"]):
        yield f"{found[1]} in the sentence, {residual['share']} in the record"
    if found := re.search(r"would add ((?:less than |more than )?[\d.]+\u00a0%) to the claim's gain", said):
        gained = next(c["score_gain"] for c in record["candidates"] if c["why"] == "claimed")
        if found[1] != percent(residual["terms"][0]["gain"] / gained):
            yield f"{found[1]} in the sentence, {residual['terms'][0]['gain']} of {gained} in the record"


def _improved(record: Record) -> Iterator[str]:
    """Yield a contradiction of the explained share of squared error with the errors on sealed or held-out logs."""
    share, floor = r"((?:less than |more than )?[\d.]+\u00a0%)", "above the noise floor"
    by_claim = re.search(rf"explains? {share} of the squared error ({floor}) that the (\w+) model", record["sentence"])
    by_nearest = rf"removes {share} of the (?:un|re)\w+ model's squared error ?({floor})? on (?:sealed|held-out) logs"
    found = by_claim or re.search(by_nearest, record["sentence"])
    if found is None:
        return
    other = "before" if "unchanged model" in found[0] else "recalibrated"
    if found[0].endswith("held-out logs"):
        ratios = [next(r["ratio"] for r in record["ladder"] if r["model"] == other)]
        ratios.append(next(r["ratio"] for r in record["ladder"] if sorted(r["names"]) == sorted(record["nearest"])))
        if found[1] != percent(1.0 - (ratios[1] / ratios[0]) ** 2):
            yield f"{found[0]} in the sentence, {ratios} in the record"
        return
    before, after = (record["error"][name]["validation"] for name in (other, "after" if by_claim else "nearest"))
    level = record["noise_floors"]["validation"] if found[2] else {}
    shares = [remaining_excess(b, after[n], level.get(n, 0.0)) for n, b in before.items() if n in after]
    shares = [max(0.0, share) for share in shares if not math.isnan(share)]
    if found[1] != percent(1.0 - sum(shares) / len(shares)):
        yield f"{found[0]} in the sentence, {before} and {after} in the record"


def _excess(record: Record, part: str = "estimation") -> dict[str, float]:
    """Return channel → remaining share of the excess error, for channels with excess."""
    before, after, floor = (
        x[part] for x in (record["error"]["before"], record["error"]["after"], record["noise_floors"])
    )
    excess = {n: (before[n], after[n], floor[n]) for n in floor if before.get(n, 0.0) > 2.0 * floor[n]}
    return {n: (a * a - f * f) / (b * b - f * f) for n, (b, a, f) in excess.items()}


def _left(record: Record) -> Iterator[str]:
    """A part leaves as much as it says, and more than a tenth; what is claimed as a whole leaves less."""
    left, said = _excess(record), record["sentence"]
    if record["grade"] == "claimed" and max(left.values(), default=0.0) > PART + NOISE:
        yield f"claimed as a whole, and {left} of the excess is left"
    if record["grade"] == "part" and record.get("horizon") == "row":
        found = re.search(r"(\d+)\u00a0% of the mean square error of (\w+)", said)
        error = record["error"]
        after, other = (error[name]["estimation"] for name in ("after", "recalibrated"))
        if found is None:
            yield f"a part, and the sentence does not say how much is left: {said!r}"
        elif abs(0.01 * float(found[1]) - (after[found[2]] / other[found[2]]) ** 2) > NOISE:
            yield f"{found[0]} in the sentence, {error} in the record"
    elif record["grade"] == "part" and "an unknown input of" in said:
        if re.search(r"unknown input of [\d.]+\u00a0% of the derivative of \w+ remains", said) is None:
            yield f"a part, and the sentence does not say how much is left: {said!r}"
    elif record["grade"] == "part" and "may take the place of" not in said and record["verdict"] != "ambiguous":
        found = re.search(r"replays keep (\d+)\u00a0% of the excess error of (\w+)", said)
        if found is None or "The rest" not in said:
            yield f"a part, and the sentence does not say how much is left: {said!r}"
        elif abs(0.01 * float(found[1]) - left.get(found[2], math.inf)) > NOISE:
            yield f"{found[0]} in the sentence, {left} in the record"


def _misses(record: Record) -> Iterator[str]:
    """By how many times what noise makes the model as it stands misses a channel."""
    found = re.search(r"as it stands misses (\w+) by ([\d.]+) times the noise floor", record["sentence"])
    if found is not None:
        before, floor = (record[k] for k in ("error", "noise_floors"))
        times = before["before"]["estimation"][found[1]] / floor["estimation"][found[1]]
        if not math.isclose(times, float(found[2]), rel_tol=0.1):
            yield f"{found[0]} in the sentence, {plain(times)} in the record"


def _floors(record: Record) -> Iterator[str]:
    """Yield floors far above the error without a warning."""
    for part, floors in record["noise_floors"].items():
        scatters = record["floor_scatters"][part]
        for name, floor in floors.items():
            errors = record["error"]
            variants = ("after",) if record["effects"] or not errors.get("nearest") else ("after", "nearest")
            after = min(errors[variant][part].get(name, math.inf) for variant in variants)
            beyond = after > 0.0 and floor > after * max(1.2, math.exp(3.0 * scatters.get(name, 0.0)))
            which = "sealed" if part == "validation" else part
            said = any(
                f"on the {which} logs the error is below its noise floor" in w and f"{name} " in w
                for w in record["warnings"]
            )
            if beyond != said:
                yield f"the floor of {name} on {part} logs is {floor}, the error {after}; said: {said}"
    if record["noise_floor"] != record["noise_floors"].get("validation", record["noise_floors"]["estimation"]):
        yield "noise_floor is none of noise_floors"


def _sealed(record: Record) -> Iterator[str]:
    """Yield contradictions of the errors on sealed logs with a rise stated at the start of the sentence."""
    for name in re.findall(r"the error of (\w+) rises from", record["sentence"]):
        variant = "after" if record["effects"] else "nearest"
        before, after = (record["error"][v]["validation"][name] for v in ("before", variant))
        if not (after > before and record["sentence"].startswith("On the sealed logs the error of ")):
            yield f"the error of {name} goes from {before} to {after}, the sentence is {record['sentence']!r}"


def _files(record: Record, folder: Path) -> Iterator[str]:
    wanted = FILES["claimed" if record["grade"] == "claimed" else "other"]
    there = {p.name for p in folder.iterdir()} - {"report.html", "refine.json", "runs"}
    if there != set(wanted):
        yield f"the grade is {record['grade']}, the files are {sorted(there)}"
