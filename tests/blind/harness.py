"""Blind suite: draw studies, run the refiner on each, open the answers, count.

    python -m tests.blind.harness 200 [--half laboratory] [--jobs 2] [--only coulomb_friction outside] [--first 0]

There are two halves, the laboratory (`truth*.py`) and the field (`field_*.py`), with the given number of studies each,
and on request mixed studies (`parts.py`), studies of an arm (`arm.py`) and of FMUs (`fmu_*.py`). Results are lines of
JSON, one per study, appended at once. A restarted run skips studies with a verdict of the same git revision. The last
line of the output is JSON: the figures of `score.summary`, with the figures of further halves under their names.
"""

from __future__ import annotations

import argparse
import itertools
import json
import shlex
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from tests.blind import arm, field_score, field_study, field_write, fmu_score, fmu_study, parts, score
from tests.blind.truth import answer, draw, write
from tests.blind.truth_outside import OUTSIDE
from tests.blind.truth_study import BASE, EFFECTS, SENSORS

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "results" / "blind.jsonl"
KINDS = ("known", "nothing", "outside")

LABORATORY, FIELD, MIXED, ARM, FMU = "laboratory", "field", "mixed", "arm", "fmu"
HALVES = {half: (half,) for half in (LABORATORY, FIELD, MIXED, ARM, FMU)} | {"both": (LABORATORY, FIELD)}
SCORES: dict[str, Any] = {LABORATORY: score, FIELD: field_score, MIXED: parts, ARM: parts, FMU: fmu_score}

Refiner = Callable[[Path, Path], None]  # (study.yaml, folder to leave refine.json in)

_writing = threading.Lock()  # one integrator at a time


class RefinerFailed(Exception):
    """Failure of the refiner to return a verdict."""


def default_command() -> str:
    """Return the command for `cosim refine` of this working tree, since an installed `cosim` may differ."""
    return f"{shlex.quote(sys.executable)} -m cosim refine {{study}} --out {{out}}"


def command_refiner(template: str, timeout: float) -> Refiner:
    """Return a refiner from a command line with {study} and {out}."""

    def refine(study: Path, out: Path) -> None:
        words = [word.format(study=study, out=out) for word in shlex.split(template)]
        try:
            done = subprocess.run(words, capture_output=True, text=True, timeout=timeout, check=False)
        except subprocess.TimeoutExpired as e:
            raise RefinerFailed(f"no verdict within {timeout:g} s") from e
        except OSError as e:
            raise RefinerFailed(str(e)) from e
        if done.returncode:
            raise RefinerFailed(f"exit {done.returncode}: {done.stderr.strip()[-500:]}")

    return refine


def revision() -> str:
    """Return the commit of the working tree, with + for uncommitted changes."""

    def git(*words: str) -> str:
        done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
        return done.stdout.strip() if done.returncode == 0 else ""

    commit = git("rev-parse", "--short=12", "HEAD") or "unknown"
    changed = git("status", "--porcelain", "--untracked-files=no")
    return commit + ("+" if changed else "")


def conduct(seed: int, refiner: Refiner, half: str = LABORATORY) -> dict[str, Any]:
    """Run the refiner on a study and return its result line.

    The refiner sees a folder with study.yaml and logs. The answer is opened after the verdict.
    """
    with tempfile.TemporaryDirectory() as open_to_all, tempfile.TemporaryDirectory() as sealed:
        folder, out, secret = Path(open_to_all) / "study", Path(open_to_all) / "out", Path(sealed) / "answer.json"
        out.mkdir()
        with _writing:
            study, told = invent(half, seed, folder)
            secret.write_text(told)
        begin = time.perf_counter()
        try:
            refiner(study, out)
            verdict = _verdict(out / "refine.json")
        except RefinerFailed as e:
            verdict = {"verdict": "failed", "effects": [], "rivals": [], "failure": str(e)}
        seconds = time.perf_counter() - begin
        return json.loads(secret.read_text()) | verdict | {"seconds": round(seconds, 2)}


def invent(half: str, seed: int, folder: Path) -> tuple[Path, str]:
    """Write the study of a seed; return the path of study.yaml, and the answer as JSON."""
    if half in (FIELD, MIXED):
        drawn = field_study.draw(seed) if half == FIELD else parts.draw(seed)
        told = field_write.answer(drawn)
        if half == MIXED:
            strangers = sorted(set(drawn.truth) & set(drawn.rig.outside))
            told = json.dumps(json.loads(told) | {"half": MIXED, "strangers": strangers})
        return field_write.write(drawn, folder), told
    if half == ARM:
        return arm.write(arm.draw(seed), folder), arm.answer(arm.draw(seed))
    if half == FMU:
        return fmu_study.write(fmu_study.draw(seed), folder), fmu_study.answer(fmu_study.draw(seed))
    return write(draw(seed), folder), answer(draw(seed))


def _verdict(path: Path) -> dict[str, Any]:
    """Return the part of refine.json for the result line, with errors of the sealed log."""
    try:
        found = json.loads(path.read_text())
        stages = ("before", "recalibrated", "after", *(("nearest",) if found["error"].get("nearest") else ()))
        error = {stage: found["error"][stage]["validation"] for stage in stages}
        line = {
            "verdict": found["verdict"],
            "effects": [{"name": e["name"], "parameters": dict(e["parameters"])} for e in found["effects"]],
            "rivals": [r if isinstance(r, str) else r["name"] for r in found.get("rivals", [])],
            "error": error,
            "noise_floor": found["noise_floor"],
        }
        line |= {name: found[name] for name in ("grade", "not_excluded", "alike") if found.get(name)}
        score.excess_left(line)  # what cannot be counted is found here, not after two hundred studies
        return line
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise RefinerFailed(f"{path.name}: {type(e).__name__}: {e}") from e


def seeds(count: int, first: int, only: Sequence[str], half: str = LABORATORY) -> list[int]:
    """Return `count` consecutive seeds from `first`; with `only`, those whose kind, plant or truth is in `only`."""
    chosen = set(only) & known_names(half)
    if only and not chosen:
        return []  # this half has none of it

    def wanted(seed: int) -> bool:
        if not only:
            return True
        if half == FMU:
            return fmu_study.is_any_of(seed, chosen)
        if half == FIELD:
            dealt = field_study.deal(seed)
            if chosen <= {*KINDS, *field_study.PLANTS}:
                return bool({dealt.kind, dealt.plant} & chosen)
            drawn = field_study.draw(seed)
            return bool({drawn.kind, drawn.plant, *drawn.truth} & chosen)
        study = draw(seed)
        return study.kind in chosen or bool(study.truth.keys() & chosen)

    return list(itertools.islice(filter(wanted, itertools.count(first)), count))


def known_names(half: str) -> set[str]:
    """Return the possible values of `--only`: kinds, plants, effects, base parameters."""
    if half in (MIXED, ARM):
        return set()
    if half == FMU:
        return {*KINDS, *fmu_study.known_names()}
    if half == FIELD:
        rigs = field_study.RIGS.values()
        return {*KINDS, *field_study.PLANTS, *(name for rig in rigs for name in (*rig.entries, *rig.outside))}
    return {*KINDS, *EFFECTS, *BASE, *SENSORS, *OUTSIDE}


def read(results: Path, of_revision: str, half: str = LABORATORY) -> dict[int, dict[str, Any]]:
    """Return seed → last result line of a revision and half; lines without a half belong to the laboratory."""
    if not results.exists():
        return {}
    lines = [json.loads(text) for text in results.read_text().splitlines() if text.strip()]
    of_half = (line for line in lines if line.get("half", LABORATORY) == half)
    return {line["seed"]: line for line in of_half if line["revision"] == of_revision}


def run(
    todo: Sequence[int], refiner: Refiner, results: Path, of_revision: str, jobs: int = 1, half: str = LABORATORY
) -> list[dict[str, Any]]:
    """Run the refiner on studies without a verdict, append each result line at once, and return all lines.

    Failed studies are repeated.
    """
    have, counted = read(results, of_revision, half), SCORES[half]
    missing = [seed for seed in todo if seed not in have or have[seed]["verdict"] == "failed"]
    results.parent.mkdir(parents=True, exist_ok=True)
    for number, line in enumerate(_conducted(missing, refiner, jobs, half), start=1):
        line = {"study": f"{line['seed']:05d}", "revision": of_revision} | line
        have[line["seed"]] = line
        with results.open("a") as file:
            file.write(json.dumps(line) + "\n")
        outcome = line.get("failure") or counted.outcome_text(line)
        print(f"{number:4d}/{len(missing)}  {counted.label(line):40} {outcome}  {line['seconds']} s", file=sys.stderr)
    return [have[seed] for seed in todo]


def _conducted(todo: Sequence[int], refiner: Refiner, jobs: int, half: str) -> Iterator[dict[str, Any]]:
    with ThreadPoolExecutor(jobs) as pool:
        pending = [pool.submit(conduct, seed, refiner, half) for seed in todo]
        try:
            yield from (done.result() for done in as_completed(pending))
        finally:
            pool.shutdown(cancel_futures=True)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.blind.harness", description=__doc__.splitlines()[0])
    parser.add_argument("count", type=int, metavar="N", help="how many studies of each half")
    parser.add_argument("--half", choices=HALVES, default="both", help="the laboratory, the field, or both")
    parser.add_argument("--jobs", type=int, default=1, help="studies at a time (seconds are honest with 1)")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="kinds, plants, effects to draw")
    parser.add_argument("--first", type=int, default=0, help="first seed; develop on others than you report")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--command", default=default_command(), help="refiner, with {study} and {out}")
    parser.add_argument("--timeout", type=float, default=600.0, help="seconds a study may take")
    options = parser.parse_args(arguments)
    if options.count < 1 or options.jobs < 1 or options.first < 0:
        parser.error("N and --jobs are at least 1, --first at least 0")
    halves = HALVES[options.half]
    if strangers := set(options.only).difference(*map(known_names, halves)):
        parser.error(f"--only does not know {', '.join(sorted(strangers))}")
    refiner, of_revision = command_refiner(options.command, options.timeout), revision()
    lines = {}
    for half in halves:
        todo = seeds(options.count, options.first, options.only, half)
        lines[half] = run(todo, refiner, options.results, of_revision, options.jobs, half)
    for half, judged in lines.items():
        print(SCORES[half].table(judged), end="\n\n")
    figures = score.summary(lines[LABORATORY]) if LABORATORY in lines else {}
    figures |= {half: SCORES[half].summary(judged) for half, judged in lines.items() if half != LABORATORY}
    print(json.dumps(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
