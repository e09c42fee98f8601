"""Mixed studies with several hidden effects, on the plants of the field half, and scores of mixed studies and the arm.

A mixed study hides two or three effects of the catalogue; every fifth hides one such effect and a stranger, an effect
outside the catalogue. Base parameters are off, a disturbance acts and the recorder has faults, as in the field half.

A true effect counts as named if it is claimed, alone or as part of the answer, or if one of at most three rivals
contains it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tests.blind import field_study
from tests.blind.field_rig import Rig
from tests.blind.field_score import put_forward
from tests.blind.field_study import Study
from tests.blind.score import LARGEST_SET, Line, alternatives, replaceable, share, wilson

HALVED = 0.5  # of the sealed error of the yardstick, from which friction has to be named


def draw(seed: int) -> Study:
    """Return the study of a seed, with several hidden effects."""
    plant = field_study.PLANTS[seed % len(field_study.PLANTS)]
    strange = (seed // len(field_study.PLANTS)) % 5 == 4 and plant != "craft"  # a craft has one effect or one stranger
    rig, rng = field_study.RIGS[plant], field_study.stream(seed, 6)
    study = field_study.bare(seed, plant, rng)
    for _ in range(50):
        names = _names(rig, rng, strange=strange)
        if (found := field_study.sized(study, names, rng, field_study.wanted_large)) is not None:
            return found
    raise RuntimeError(f"seed {seed}: no parts that can be seen")


def _names(rig: Rig, rng: Any, *, strange: bool) -> list[str]:
    """Return two or three effects of the catalogue; with `strange` an effect of the catalogue and one outside."""
    if strange:
        return [str(rng.choice(sorted(rig.entries))), str(rng.choice(sorted(rig.outside)))]
    return field_study.names_of(rig, rng, int(rng.integers(2, 4)))


# -- what counts -------------------------------------------------------------------------------------------


def parts(line: Line) -> set[str]:
    """Return the true effects of a study without strangers (effects outside the catalogue)."""
    return set(line["truth"]) - set(line.get("strangers", ()))


def named_parts(line: Line) -> set[str]:
    """Return the true effects that a verdict claims, wholly or in part, or that one of a few rivals contains."""
    sets = alternatives(line)
    shared = set().union(*sets) if 0 < len(sets) <= LARGEST_SET else set()
    return parts(line) & (put_forward(line) | shared)


def wrong_parts(line: Line) -> set[str]:
    """Return names that a verdict claims, wholly or in part, and that are not true effects of the catalogue.

    A name in whose place the verdict leaves the true effect open is not wrong.
    """
    open_cases = {claimed for claimed, other in replaceable(line) if other in parts(line)}
    return put_forward(line) - parts(line) - open_cases


def is_due(line: Line) -> bool:
    """Return whether friction in a least-squares fit of the arm at least halves a channel's error on the sealed log."""
    errors = line["yardstick"]
    return any(w <= HALVED * o for o, w in zip(errors["without"], errors["with"], strict=True))


def counts(lines: Sequence[Line]) -> dict[str, tuple[int, int]]:
    """Return figure → (number of hits, number of cases)."""
    known = [line for line in lines if line["kind"] == "known" and ("yardstick" not in line or is_due(line))]
    forward = sum(len(put_forward(line)) for line in lines)
    return {
        "all_parts_named": (sum(named_parts(line) == parts(line) for line in known), len(known)),
        "parts_named": (sum(len(named_parts(line)) for line in known), sum(len(parts(line)) for line in known)),
        "wrong_parts": (sum(len(wrong_parts(line)) for line in lines), forward),
        "studies_with_wrong_parts": (sum(bool(wrong_parts(line)) for line in lines), len(lines)),
    }


def summary(lines: Sequence[Line]) -> dict[str, Any]:
    """Return figure → share of its cases."""
    return {"studies": len(lines)} | {name: share(*counted) for name, counted in counts(lines).items()}


def label(line: Line) -> str:
    """Return the plant and the hidden names as label of a row."""
    return f"{line['plant']}: {' + '.join(sorted(line['truth'])) or 'nothing'}"


def outcome_text(line: Line) -> str:
    """Return the outcome of a study: number of named effects, wrong names, verdict and grade."""
    told = f"{len(named_parts(line))} of {len(parts(line))}"
    wrong = "".join(f", wrong: {name}" for name in sorted(wrong_parts(line)))
    return f"{told}{wrong} ({line['verdict']}, {line.get('grade', '')})"


def table(lines: Sequence[Line]) -> str:
    """Return a table with a row per study, then the figures with Wilson's 95 % intervals."""
    text = [f"{label(line):70} {outcome_text(line)}" for line in lines]
    for name, (hits, of) in counts(lines).items():
        low, high = wilson(hits, of)
        part = f"{100 * hits / of:5.1f} %" if of else "    – "
        text.append(f"{name:25} {hits:4d} of {of:4d}  {part}  [{100 * low:5.1f}, {100 * high:5.1f}]")
    return "\n".join(text)
