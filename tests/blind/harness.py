"""Blind suite: draw studies, run the refiner on each, open the answers, count.

    python -m tests.blind.harness 200 [--half laboratory] [--jobs 2] [--only coulomb_friction outside] [--first 0]

There are two halves, the laboratory (`truth*.py`) and the field (`field_*.py`), with the given number of studies each,
and on request mixed studies (`parts.py`), studies of an arm (`arm.py`) and of FMUs (`fmu_*.py`). Results are lines of
JSON, one per study, appended at once. A restarted run skips studies with a verdict of the same git revision. The last
line of the output is JSON: the figures of `score.summary`, with the figures of further halves under their names.
"""

from __future__ import annotations

import argparse
import fcntl
import itertools
import json
import resource
import shlex
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from tests.blind import arm, field_study, field_write, fmu_study, parts, score, truth
from tests.blind.score import ARM, FIELD, FMU, KINDS, LABORATORY, MIXED, Line
from tests.blind.truth_outside import OUTSIDE
from tests.blind.truth_study import BASE, EFFECTS, SENSORS

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "results" / "blind.jsonl"
HALVES = {half: (half,) for half in (LABORATORY, FIELD, MIXED, ARM, FMU)} | {"both": (LABORATORY, FIELD)}
STAGES = ("before", "recalibrated", "after", "nearest")

Refiner = Callable[[Path, Path], Any]  # (study.yaml, folder to leave refine.json in)

_writing = threading.Lock()  # one integrator at a time


class RefinerFailed(Exception):
    """Failure of the refiner to return a verdict."""


# -- one study ---------------------------------------------------------------------------------------------


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


def invent(half: str, seed: int, folder: Path) -> tuple[Path, str]:
    """Write the study of a seed; return the path of study.yaml, and the answer as JSON."""
    if half == MIXED:
        mixed = parts.draw(seed)
        strangers = sorted(set(mixed.truth) & set(mixed.rig.outside))
        return field_write.write(mixed, folder), field_write.answer(mixed, half=MIXED, strangers=strangers)
    draws: dict[str, tuple[Any, Any]] = {
        LABORATORY: (truth, truth.draw),
        FIELD: (field_write, field_study.draw),
        ARM: (arm, arm.draw),
        FMU: (fmu_study, fmu_study.draw),
    }
    module, draw = draws[half]
    study = draw(seed)
    return module.write(study, folder), module.answer(study)


def refined(half: str, seed: int, folder: Path, refiner: Refiner) -> tuple[Line, Line]:
    """Draw and refine a study in a folder; return its answer, and refine.json (or the failure) with the seconds.

    The refiner sees a folder with study.yaml and logs, and not the answer.
    """
    with _writing:
        study, told = invent(half, seed, folder / "study")
    out = folder / "out"
    out.mkdir()
    begin, used = time.perf_counter(), _processor_seconds()
    try:
        refiner(study, out)
        found = json.loads((out / "refine.json").read_text())
    except (RefinerFailed, OSError, ValueError) as e:
        found = {"verdict": "failed", "failure": str(e)}
    seconds = {"seconds": time.perf_counter() - begin, "processor_seconds": _processor_seconds() - used}
    return json.loads(told), found | seconds


def _processor_seconds() -> float:
    """Return the processor seconds of this process, of the child processes that have ended, and of theirs."""
    both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(used.ru_utime + used.ru_stime for used in both)


def conduct(seed: int, refiner: Refiner, half: str = LABORATORY) -> Line:
    """Run the refiner on a study and return its result line, with errors of the sealed log."""
    with tempfile.TemporaryDirectory() as folder:
        told, found = refined(half, seed, Path(folder), refiner)
    try:
        line = {
            "verdict": found["verdict"],
            "effects": [{"name": e["name"], "parameters": dict(e["parameters"])} for e in found["effects"]],
            "rivals": names_of_rivals(found),
            "error": {stage: found["error"][stage]["validation"] for stage in STAGES if found["error"].get(stage)},
            "noise_floor": found["noise_floor"],
        }
        line |= {name: found[name] for name in ("grade", "not_excluded", "alike") if found.get(name)}
        score.excess_left(line)  # what cannot be counted is found here, not after two hundred studies
    except (KeyError, TypeError, ValueError, AttributeError) as e:
        why = found.get("failure") or f"refine.json: {type(e).__name__}: {e}"
        line = {"verdict": "failed", "effects": [], "rivals": [], "failure": why}
    return told | line | {"seconds": round(found["seconds"], 2)}


def names_of_rivals(found: Line) -> list[str]:
    """Return the names of the rivals in refine.json."""
    return [r if isinstance(r, str) else r["name"] for r in found.get("rivals", ())]


# -- all studies -------------------------------------------------------------------------------------------


def revision() -> str:
    """Return the commit of the working tree, with + for uncommitted changes."""

    def git(*words: str) -> str:
        done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
        return done.stdout.strip() if done.returncode == 0 else ""

    commit = git("rev-parse", "--short=12", "HEAD") or "unknown"
    return commit + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")


def seeds(count: int, first: int, only: Sequence[str], half: str = LABORATORY) -> list[int]:
    """Return `count` consecutive seeds from `first`; with `only`, those whose kind, plant or truth is in `only`."""
    chosen = set(only) & known_names(half)
    if only and not chosen:
        return []  # this half has none of it

    def wanted(seed: int) -> bool:
        if half == FMU:
            return fmu_study.is_any_of(seed, chosen)
        if half == FIELD and chosen <= {*KINDS, *field_study.PLANTS}:
            dealt = field_study.deal(seed)
            return bool({dealt.kind, dealt.plant} & chosen)
        study: Any = field_study.draw(seed) if half == FIELD else truth.draw(seed)
        return bool({study.kind, getattr(study, "plant", ""), *study.truth} & chosen)

    return list(itertools.islice((s for s in itertools.count(first) if not only or wanted(s)), count))


def known_names(half: str) -> set[str]:
    """Return the possible values of `--only`: kinds, plants, effects, base parameters."""
    if half in (MIXED, ARM):
        return set()
    if half == LABORATORY:
        return {*KINDS, *EFFECTS, *BASE, *SENSORS, *OUTSIDE}
    if half == FMU:
        return {*KINDS, *fmu_study.known_names()}
    return {*KINDS, *field_study.PLANTS, *(name for rig in field_study.RIGS.values() for name in rig.every_entry)}


def read(results: Path) -> list[Line]:
    """Return the lines of a file of results."""
    return [json.loads(text) for text in results.read_text().splitlines() if text.strip()] if results.exists() else []


def append(path: Path, line: Line) -> None:
    """Add a line to a file that several commands may write."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.write(json.dumps(line, separators=(",", ":"), ensure_ascii=False) + "\n")


def conducted(keys: Iterable[Any], one: Callable[[Any], Any], jobs: int) -> Iterator[tuple[Any, Any]]:
    """Return each key with its result as soon as it is there, several at a time."""
    with ThreadPoolExecutor(jobs) as pool:
        pending = {pool.submit(one, key): key for key in keys}
        try:
            yield from ((pending[done], done.result()) for done in as_completed(pending))
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def run(
    todo: Sequence[int], refiner: Refiner, results: Path, of_revision: str, jobs: int = 1, half: str = LABORATORY
) -> list[Line]:
    """Run the refiner on studies without a verdict, append each result line at once, and return all lines.

    Failed studies are repeated. Lines without a half belong to the laboratory.
    """
    of_half = (line for line in read(results) if line.get("half", LABORATORY) == half)
    have = {line["seed"]: line for line in of_half if line["revision"] == of_revision}
    missing = [seed for seed in todo if seed not in have or have[seed]["verdict"] == "failed"]
    results_of = conducted(missing, lambda seed: conduct(seed, refiner, half), jobs)
    for number, (seed, line) in enumerate(results_of, start=1):
        have[seed] = {"study": f"{seed:05d}", "revision": of_revision} | line
        append(results, have[seed])
        outcome = line.get("failure") or score.outcome_text(half, line)
        print(
            f"{number:4d}/{len(missing)}  {score.label(half, line):40} {outcome}  {line['seconds']} s", file=sys.stderr
        )
    return [have[seed] for seed in todo]


def main(arguments: Sequence[str] | None = None) -> int:
    # an installed `cosim` may differ from this working tree
    command = f"{shlex.quote(sys.executable)} -m cosim refine {{study}} --out {{out}}"
    parser = argparse.ArgumentParser(prog="python -m tests.blind.harness", description=__doc__.splitlines()[0])
    parser.add_argument("count", type=int, metavar="N", help="how many studies of each half")
    parser.add_argument("--half", choices=HALVES, default="both", help="the laboratory, the field, or both")
    parser.add_argument("--jobs", type=int, default=1, help="studies at a time (seconds are honest with 1)")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="kinds, plants, effects to draw")
    parser.add_argument("--first", type=int, default=0, help="first seed; develop on others than you report")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--command", default=command, help="refiner, with {study} and {out}")
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
        print(score.table(half, judged), end="\n\n")
    summaries = {half: score.summary(half, judged) for half, judged in lines.items()}
    print(json.dumps(summaries.pop(LABORATORY, {}) | summaries))
    return 0


if __name__ == "__main__":
    sys.exit(main())
