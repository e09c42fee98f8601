"""Verdicts of one revision on fixed blind studies, a line of JSON each in `baseline.jsonl`: `make baseline`.

    python -m tests.blind.baseline                                     go on with the revision in tests/corpus/revision
    python -m tests.blind.baseline --python ENV/bin/python --revision SHA
    python -m tests.blind.baseline --summary [--revision SHA]          the table
    python -m tests.blind.baseline --confirmatory --revision SHA       the studies announced in docs/blind.md
    python -m tests.blind.baseline --confirmatory --revision SHA --against OLD      its table, new beside old

This tree draws a study, the environment of the revision refines it. Ctrl-C loses the studies that are under way. Model
files of plants are those of the revision, whose classes they use. A near-tie is a study that cannot be told from
another: it stays, and figures are printed with and without such studies.
"""

import argparse
import json
import math
import os
import shlex
import signal
import statistics
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from tests.blind import harness, score
from tests.blind.harness import Key, read
from tests.blind.score import ARM, FIELD, FMU, LABORATORY, MIXED, Line
from tests.corpus import revisions

LINES = Path(__file__).with_name("baseline.jsonl")
SUITES = {  # suite → first seed, number of studies; chosen before any of these seeds was drawn
    LABORATORY: (410000, 40),
    FIELD: (420000, 80),
    MIXED: (430000, 40),
    ARM: (440000, 30),
    FMU: (450000, 80),
}
CONFIRMATORY = LINES.with_name("confirmatory.json")  # suite → seeds, chosen before any of them was refined
TIMEOUT = 3600.0  # time limit of a study [s]
ONE_SIDED = statistics.NormalDist().inv_cdf(0.95)


# -- studies -----------------------------------------------------------------------------------------------


def conduct(suite: str, seed: int, python: str, revision: str) -> Line:
    """Draw a study, refine it with the Python of an environment, and return its line.

    Args:
        suite: of the study.
        seed: of the study.
        python: of the environment.
        revision: whose model files of plants are used; one that ends in + is this tree.
    """
    command = f"{shlex.quote(python)} -P -m cosim refine {{study}} --out {{out}}"

    def refiner(study: Path, out: Path) -> None:
        for path in study.parent.glob("*.py") if not revision.endswith("+") else ():
            path.write_bytes(revisions.git("show", f"{revision}:tests/blind/plants/{path.name}"))
        harness.refine_by(command, TIMEOUT, study, out)

    _, line = harness.conduct(suite, seed, refiner)
    del line["seconds"]
    return line | {"revision": revision}


def missing(path: Path, revision: str, suites: Sequence[str] = (), *, confirmatory: bool = False) -> list[Key]:
    """Return the studies without a line of a revision, suites in turn."""
    have = read(path, revision)
    rows = {suite: [*range(first, first + count)] for suite, (first, count) in SUITES.items()}
    if confirmatory:
        rows = json.loads(CONFIRMATORY.read_text())
    table = sorted((k / len(seeds), suite, seed) for suite, seeds in rows.items() for k, seed in enumerate(seeds))
    return [(suite, seed) for _, suite, seed in table if (suite, seed) not in have and (not suites or suite in suites)]


# -- the table ---------------------------------------------------------------------------------------------


def table(lines: Sequence[Line]) -> str:
    """Return the figures of each suite with 95 % intervals, of all studies and of those that are no near-ties.

    The lines of the first revision, which was compared with the nearest other effect of each study, say `near_tie`.
    """
    text, ties = [], {key for key, line in read(LINES).items() if line.get("near_tie")}
    for suite, (_, of) in SUITES.items():
        every = [line for line in lines if line["suite"] == suite]
        apart = [line for line in every if (suite, line["seed"]) not in ties]
        failed = sum(line["verdict"] == "failed" for line in every)
        text += ["", f"{suite}: {len(every)} of {of} studies, {failed} failed, {len(every) - len(apart)} near-ties"]
        counted, without = score.counts(suite, every), score.counts(suite, apart)
        for name, pair in counted.items():
            text.append(f"  {name:25}{score.share_text(*pair, 3)}")
            if len(apart) < len(every):
                text[-1] += f"   without near-ties{score.share_text(*without[name], 3)}"
        if every:
            seconds = sorted(line["processor_seconds"] for line in every)
            late = seconds[math.ceil(0.95 * len(seconds)) - 1]
            text.append(f"  processor seconds: median {statistics.median(seconds):.0f}, 95 % {late:.0f}")
    return "\n".join(text[1:])


def comparison(old: Mapping[Key, Line], new: Mapping[Key, Line]) -> str:
    """Return the announced figures of two revisions on the same studies."""
    pairs = [(old[key], new[key]) for key in sorted(old.keys() & new.keys())]
    known, nothing, outside = ([pair for pair in pairs if pair[0]["kind"] == kind] for kind in score.KINDS)

    def points(chosen: Sequence[tuple[Line, Line]], holds: Callable[[Line], bool]) -> str:
        gains = [100.0 * (holds(b) - holds(a)) for a, b in chosen]
        if len(gains) < 2:
            return "–"
        mean, error = statistics.fmean(gains), ONE_SIDED * statistics.stdev(gains) / math.sqrt(len(gains))
        counted = " → ".join(str(sum(map(holds, side))) for side in zip(*chosen, strict=True))
        return (
            f"{counted} of {len(chosen)}: {mean:+.1f} points, 95 % bounds {mean - error:+.1f} and {mean + error:+.1f}"
        )

    def ratios(of: Callable[[Line], Mapping[str, float]]) -> list[float]:
        each = [(of(a), of(b)) for a, b in pairs if "failed" not in (a["verdict"], b["verdict"])]
        both = [[b[n] / a[n] for n in a.keys() & b.keys() if a[n] and b[n]] for a, b in each]
        return [statistics.geometric_mean(found) for found in both if found]

    alarms = [[score.is_false_alarm(pair[side]) for pair in nothing] for side in (0, 1)]
    text = [f"{len(pairs)} studies", f"right: {points(known, score.is_right)}"]
    text += [f"  {s}: {points([pair for pair in known if pair[0]['suite'] == s], score.is_right)}" for s in SUITES]
    text.append(f"wrong or misnamed: {points([*known, *outside], score.is_wrong)}")
    text.append(f"false alarms: {sum(alarms[0])} → {sum(alarms[1])} of {len(nothing)}")
    for suite in SUITES:
        chosen = [pair for pair in outside if pair[0]["suite"] == suite]
        text.append(f"outside flagged, {suite}: {points(chosen, score.is_flagged)}")
    hold = score.share_text(*score.coverage(new_line for _, new_line in pairs), 3)
    text.append(f"95 % intervals that hold the truth:{hold}")
    if pairs:
        errors = ratios(score.delivered)
        text.append(f"sealed error, geometric mean of new over old: {statistics.geometric_mean(errors):.3f}")
        seconds = statistics.median(ratios(lambda line: {"": line["processor_seconds"]}))
        text.append(f"processor time of a study, median of new over old: {seconds:.2f}")
    return "\n".join(text)


# -- the command -------------------------------------------------------------------------------------------


def commit_of(named: str | None) -> str:
    """Return the full hash of a revision, by default of that of the corpus; one that ends in + is left as it is."""
    named = named or revisions.revision()
    if named.endswith("+"):
        return named
    return revisions.git("rev-parse", "--verify", f"{named}^{{commit}}").decode().strip()


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.blind.baseline", description=__doc__.splitlines()[0])
    parser.add_argument("suites", nargs="*", metavar="SUITE", help=f"{', '.join(SUITES)}; by default all")
    parser.add_argument("--revision", help="by default the one in tests/corpus/revision")
    parser.add_argument("--python", help="of an environment; by default one with the wheels of the revision")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)), help="studies at a time")
    parser.add_argument("--lines", type=Path, help="file of lines")
    parser.add_argument("--confirmatory", action="store_true", help="the studies that docs/blind.md announces")
    parser.add_argument("--against", metavar="SHA", help="print the figures beside those of this revision, run nothing")
    parser.add_argument("--summary", action="store_true", help="print the table, run nothing")
    options = parser.parse_args(arguments)
    if strangers := set(options.suites) - set(SUITES):
        parser.error(f"unknown suites {', '.join(sorted(strangers))}; there are {', '.join(SUITES)}")
    commit = commit_of(options.revision)
    revision = commit if commit.endswith("+") else commit[:12]
    lines = options.lines or (LINES.with_name("confirmatory.jsonl") if options.confirmatory else LINES)
    if options.against:
        print(comparison(read(lines, commit_of(options.against)[:12]), read(lines, revision)))
        return 0
    if not options.summary:
        python = options.python or str(revisions.revision_side(commit).programs / "python")
        if subprocess.run([python, "-P", "-c", "import cosim, plant"]).returncode:
            parser.error(f"{python} has no cosim and hovercraft")
        todo = missing(lines, revision, options.suites, confirmatory=options.confirmatory)
        one = partial(conduct, python=python, revision=revision)
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            if harness.run(todo, one, lines, options.jobs):
                return 1
        except KeyboardInterrupt:
            print("stopped; the same command goes on", file=sys.stderr)
            return 130
    print(f"revision {revision}\n{table(list(read(lines, revision).values()))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
