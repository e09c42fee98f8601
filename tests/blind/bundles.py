"""Decision bundles of blind studies, on which rules are compared within seconds: `make bundles`.

    python -m tests.blind.bundles SUITE:FIRST:COUNT …    refine these studies, as far as their bundles are missing
    python -m tests.blind.bundles                        the table of alternatives on all bundles

A bundle is what the decision of a study depends on (`cosim/refinement/decision/posterior.py`). It is kept with the
line of the study in `build/bundles`, which is not in the repository. Alternatives are judged by names alone.
"""

import argparse
import pickle
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from cosim.refinement.decision import posterior as rules
from cosim.refinement.decision.posterior import Bundle, Decision, Evidence, decide
from cosim.refinement.workflow import refine
from tests.blind import harness, score
from tests.blind.score import Line

FOLDER = Path(__file__).resolve().parents[2] / "build" / "bundles"
Rule = Callable[[Bundle], Decision]


def keep(suite: str, seed: int) -> Line:
    """Refine a study, and keep its bundle and line."""
    results: list[Any] = []
    _, line = harness.conduct(suite, seed, lambda study, out: results.append(refine(study, out, report=False)))
    if not results:
        raise harness.StudyFailed(line["failure"])
    place = FOLDER / f"{suite}_{seed}.pickle"
    place.with_suffix(".part").write_bytes(pickle.dumps((results[0].verdict.bundle, line)))
    place.with_suffix(".part").rename(place)
    return line


def judged(line: Line, decision: Decision) -> Line:
    """Return the line of a study with another decision."""
    rivals = [" + ".join(sorted(parts)) or "no_effect" for parts in decision.rivals]
    effects = [{"name": name, "parameters": {}} for name in decision.claimed]
    left_open = [{"name": rich, "in_place_of": simple} for rich, simple in decision.not_excluded]
    found = {"verdict": decision.verdict, "grade": decision.grade, "rivals": rivals, "effects": effects}
    return {**line, **found, "not_excluded": left_open}


# -- alternatives ------------------------------------------------------------------------------------


def with_numbers(**numbers: Any) -> Rule:
    """Return the rule with other deciding numbers."""

    def decided(bundle: Bundle) -> Decision:
        with patch.multiple(rules, **numbers):
            return decide(bundle)

    return decided


def with_widths(times: float) -> Rule:
    """Return the rule with all usual sizes multiplied."""

    def widened(h: Evidence) -> Evidence:
        return replace(h, parameters=tuple(replace(p, width=times * p.width) if p.is_size else p for p in h.parameters))

    return lambda bundle: decide(replace(bundle, hypotheses=[widened(h) for h in bundle.hypotheses]))


def strictly(bundle: Bundle) -> Decision:
    """Decide with every claim withdrawn where unnamed terms are significant."""
    return decide(replace(bundle, misfit=replace(bundle.misfit, beside=dict.fromkeys(bundle.kinds, 0.0))))


RULES: dict[str, Rule] = {
    "as it is": decide,
    "no dispersion": with_numbers(dispersion=lambda h: 1.0),
    "certain from 0.9": with_numbers(CERTAIN=0.9),
    "certain from 0.99": with_numbers(CERTAIN=0.99),
    "lack of fit below 1 %": with_numbers(MISFIT=1e-2),
    "lack of fit below 1e-4": with_numbers(MISFIT=1e-4),
    "every lack of fit withdraws": strictly,
    "no abstention by lack of fit": with_numbers(MISFIT=0.0),
    "unknown inputs up to 10 %": with_numbers(UNKNOWN_INPUT=0.1),
    "one width of sizes": with_numbers(MIXTURE=(1.0,)),
    "usual sizes × 1/3": with_widths(1 / 3),
    "usual sizes × 3": with_widths(3.0),
    "prior 1/4 of each further part": with_numbers(PART=0.25),
    "without equivalent sets": lambda bundle: decide(replace(bundle, equivalent=())),
}


def table(kept: Iterable[tuple[Bundle, Line]]) -> list[str]:
    """Return the table of alternatives: figures, and the share of studies with the verdict and names of the rule."""
    kept = list(kept)
    usual = [judged(line, decide(bundle)) for bundle, line in kept]
    rows, figures = [], score.counts(score.FIELD, ())
    for name, rule in RULES.items():
        lines = [judged(line, rule(bundle)) for bundle, line in kept]
        figures = score.counts(score.FIELD, lines)
        same = [(a["verdict"], a["effects"]) == (b["verdict"], b["effects"]) for a, b in zip(lines, usual, strict=True)]
        cells = [f"{hits} of {of}" for hits, of in figures.values()]
        rows.append(f"| {name} | {' | '.join(cells)} | {np.mean(same):.0%} |")
    return [f"| rule | {' | '.join(figures)} | same |", f"|{'---|' * (len(figures) + 2)}", *rows]


def main() -> None:
    """Keep missing bundles, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studies", nargs="*", metavar="SUITE:FIRST:COUNT")
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    FOLDER.mkdir(parents=True, exist_ok=True)
    wanted = [(suite, int(first), int(count)) for suite, first, count in (s.split(":") for s in given.studies)]
    todo = sorted((k, suite, first + k) for suite, first, count in wanted for k in range(count))  # suites in turn
    missing = [(suite, seed) for _, suite, seed in todo if not (FOLDER / f"{suite}_{seed}.pickle").exists()]
    harness.run(missing, keep, FOLDER / "lines.jsonl", given.jobs)
    if not wanted:
        print(*table(pickle.loads(place.read_bytes()) for place in sorted(FOLDER.glob("*.pickle"))), sep="\n")


if __name__ == "__main__":
    main()
