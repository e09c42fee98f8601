"""Scores of the FMUs' suite: those of the field half, by way and by size of the effects."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from tests.blind import field_score
from tests.blind.field_score import outcome_text
from tests.blind.score import Line, wilson

FIGURES = ("right", "in_set", "wrong", "false_alarms", "no_effect", "outside_flagged", "outside_misnamed", "coverage")
BY_SIZE = ("right", "in_set", "wrong", "coverage")

__all__ = ["counts", "label", "outcome_text", "summary", "table"]


def counts(lines: Sequence[Line]) -> dict[str, tuple[int, int]]:
    """Return figure → (number of hits, number of cases)."""
    every = field_score.counts(lines)
    return {name: every[name] for name in FIGURES}


def groups(lines: Sequence[Line]) -> dict[str, tuple[tuple[str, ...], list[Line]]]:
    """Return group → (its figures, its lines): sizes, ways, both together."""
    found: dict[str, tuple[tuple[str, ...], list[Line]]] = {}
    for line in lines:
        size, way = line["size"], line["way"]
        names = {way: FIGURES} | ({size: BY_SIZE, f"{size}, {way}": BY_SIZE} if size else {})
        for name, figures in names.items():
            found.setdefault(name, (figures, []))[1].append(line)
    return dict(sorted(found.items()))


def summary(lines: Sequence[Line]) -> dict[str, Any]:
    """Return the entry `fmu` in the last line of the output; None for figures without cases."""
    whole = field_score.summary(lines)
    others = ("sealed_ratio_median", "sealed_ratio_90", "seconds_median", "seconds_95")
    return {name: whole[name] for name in ("studies", *FIGURES, *others)} | {
        "by": {
            group: {"studies": len(chosen)} | field_score.shares(counts(chosen), figures)
            for group, (figures, chosen) in groups(lines).items()
        }
    }


def label(line: Line) -> str:
    """Return plant, way, version, size and hidden names as label of a row."""
    way = "".join(word[0] for word in line["way"].split("_"))
    hidden = " + ".join(sorted(line["truth"])) or "nothing"
    return f"{line['plant']} {way}{line['version']}: {line['size'] or line['kind']}: {hidden}"


def table(lines: Sequence[Line]) -> str:
    """Return the outcomes by plant, then the figures of all, and those by size and way."""
    columns = ("right", "in set", "part", "wrong", "no_effect", "unexplained", "ambiguous", "failed")
    text = [f"{'fmu':48} {'n':>3}  " + "  ".join(columns)]
    rows: dict[str, list[Line]] = defaultdict(list)
    for line in lines:
        rows[f"{line['plant']}, {line['kind']}{', ' if line['size'] else ''}{line['size']}"].append(line)
    for name, chosen in sorted(rows.items()):
        outcomes = [outcome_text(line).split(": ")[0] for line in chosen]
        cells = "  ".join(f"{outcomes.count(c) or '·':>{len(c)}}" for c in columns)
        text.append(f"{name:48} {len(chosen):3d}  {cells}")
    for group, (figures, chosen) in ({"all": (FIGURES, list(lines))} | groups(lines)).items():
        text += ["", group]
        for name in figures:
            hits, of = counts(chosen)[name]
            low, high = wilson(hits, of)
            part = f"{100 * hits / of:5.1f} %" if of else "    – "
            text.append(f"{name:25} {hits:4d} of {of:4d}  {part}  [{100 * low:5.1f}, {100 * high:5.1f}]")
    return "\n".join(text)
