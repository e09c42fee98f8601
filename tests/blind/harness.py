"""Blind suite: draw studies, run the refiner on each, open the answers, count.

    python -m tests.blind.harness 200 [--half laboratory] [--jobs 2] [--only coulomb_friction outside] [--first 0]

There are two halves, the laboratory (`truth*.py`) and the field (`field_*.py`), with the given number of studies each,
and on request mixed studies, studies of an arm (`arm.py`) and of FMUs (`fmu_*.py`). Results are lines of JSON, one per
study, appended at once. A restarted run skips studies with a verdict of the same git revision. The last line of the
output is JSON: the figures of `score.summary`, with the figures of further halves under their names.
"""

import argparse
import fcntl
import itertools
import json
import os
import resource
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from joblib import Parallel, delayed

from tests.blind import arm, field_study, fmu_study, score, truth
from tests.blind.score import ARM, FIELD, FMU, LABORATORY, MIXED, Line
from tests.corpus import revisions

RESULTS = revisions.ROOT / "results" / "blind.jsonl"
DRAWS: dict[str, tuple[Any, Callable[[int], Any]]] = {  # suite → module with `write` and `answer`; seed → its study
    LABORATORY: (truth, truth.draw),
    FIELD: (field_study, field_study.draw),
    MIXED: (field_study, field_study.draw_mixed),
    ARM: (arm, arm.draw),
    FMU: (fmu_study, fmu_study.draw),
}
QUICK: dict[str, Callable[[int], Any]] = {  # suite → what `--only` chooses from: seed → what is known of it at once
    LABORATORY: lambda seed: vars(truth.draw(seed)),
    FIELD: field_study.deal,
    FMU: fmu_study.deal,
}
FAR = 10_000  # seeds after which `--only` gives up
HALVES = {half: (half,) for half in DRAWS} | {"both": (LABORATORY, FIELD)}
STUDY = ("kind", "plant", "way", "version", "size", "disturbance", "disturbed", "truth", "strangers", "costs")
ANSWER = ("error_true", "yardstick")
FOUND = ("verdict", "grade", "not_excluded", "alike", "failure")
STAGES = ("before", "recalibrated", "after", "nearest")
SETS = ("estimation", "validation")
BEST = 5  # candidates with scores
TIMEOUT = 600.0  # time limit of a study [s]

Key = tuple[str, int]  # suite, seed
Refiner = Callable[[Path, Path], Any]  # (study.yaml, folder to leave refine.json in)
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class StudyFailed(Exception):
    """Failure to draw a study, or of the refiner to return a verdict."""


# -- one study ---------------------------------------------------------------------------------------------


def refine_by(command: str, timeout: float, study: Path, out: Path) -> None:
    """Refine a study by a command line with {study} and {out}, within a limit of time [s]."""
    words = [word.format(study=study, out=out) for word in shlex.split(command)]
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment = kept | ONE_THREAD | {"TMPDIR": str(out.parent)}
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=timeout, check=False, env=environment)
    except subprocess.TimeoutExpired as e:
        raise StudyFailed(f"no verdict within {timeout:g} s") from e
    except OSError as e:
        raise StudyFailed(str(e)) from e
    if done.returncode:
        raise StudyFailed(f"exit {done.returncode}: {done.stderr.strip()[-500:]}")


def invent(suite: str, seed: int, folder: Path) -> tuple[Path, str]:
    """Write the study of a seed; return the path of study.yaml, and the answer as JSON."""
    module, draw = DRAWS[suite]
    study = draw(seed)
    return module.write(study, folder), module.answer(study)


def conduct(suite: str, seed: int, refiner: Refiner) -> tuple[Line, Line]:
    """Draw and refine a study; return its answer and its line.

    The refiner sees a folder with study.yaml and logs, and not the answer.
    """
    with tempfile.TemporaryDirectory(prefix="blind-") as folder:
        study, answer = invent(suite, seed, Path(folder) / "study")
        told, out = json.loads(answer), Path(folder) / "out"
        out.mkdir()
        begin, used = time.perf_counter(), _processor_seconds()
        try:
            refiner(study, out)
            line = line_of(suite, told, json.loads((out / "refine.json").read_text()))
            score.excess_left(line)  # what cannot be counted is found here, not after two hundred studies
        except StudyFailed as e:
            line = line_of(suite, told, {"verdict": "failed", "failure": str(e)})
        except (OSError, KeyError, TypeError, ValueError, AttributeError) as e:
            line = line_of(suite, told, {"verdict": "failed", "failure": f"refine.json: {type(e).__name__}: {e}"})
    line["seconds"] = round(time.perf_counter() - begin, 2)
    return told, line | {"processor_seconds": round(_processor_seconds() - used, 1)}


def _processor_seconds() -> float:
    """Return the processor seconds of this process, of the child processes that have ended, and of theirs."""
    both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(used.ru_utime + used.ru_stime for used in both)


def line_of(suite: str, told: Line, found: Line) -> Line:
    """Return the line of a study from its answer and from refine.json, numbers with six digits.

    `error` has stage → set of logs → channel; `sensors` are only those of the truth.
    """
    line = {"suite": suite, "seed": told["seed"]} | {key: told[key] for key in (*STUDY, *ANSWER) if key in told}
    line["sensors"] = sorted(set(told.get("sensors", ())) & set(told["truth"]))
    line |= {key: found[key] for key in FOUND if found.get(key)} | {"verdict": found["verdict"]}
    line["rivals"] = [r if isinstance(r, str) else r["name"] for r in found.get("rivals", ())]
    line["effects"] = [
        {
            "name": e["name"],
            "parameters": {p: {k: v.get(k) for k in ("value", "ci95")} for p, v in e["parameters"].items()},
        }
        for e in found.get("effects", ())
    ]
    line["scores"] = [
        [" + ".join(c["names"]), c.get("log_likelihood_gain"), c.get("score_gain")]
        for c in found.get("candidates", ())[:BEST]
    ]
    errors = found.get("error") or {}
    line["error"] = {
        stage: {logs: errors[stage][logs] for logs in SETS if logs in errors[stage]}
        for stage in STAGES
        if errors.get(stage)
    }
    line["noise_floor"] = found.get("noise_floor") or {}
    return dict(_rounded(line))


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, dict):
        return {key: _rounded(v) for key, v in value.items()}
    return [_rounded(v) for v in value] if isinstance(value, list | tuple) else value


# -- all studies -------------------------------------------------------------------------------------------


def read(path: Path, revision: str = "") -> dict[Key, Line]:
    """Return (suite, seed) → line of a revision, by default of any, in a file of results."""
    lines = [json.loads(text) for text in path.read_text().splitlines() if text.strip()] if path.exists() else []
    return {(line["suite"], line["seed"]): line for line in lines if revision in ("", line["revision"])}


def run(todo: Sequence[Key], one: Callable[[str, int], Line], path: Path, jobs: int = 1) -> int:
    """Conduct studies, in processes if `jobs` are several, and append each line at once; return how many failed.

    Args:
        one: conducts a study and returns its line, or raises StudyFailed.
    """
    failed = 0
    path.parent.mkdir(parents=True, exist_ok=True)
    made = Parallel(jobs, return_as="generator_unordered")(delayed(_attempt)(one, *key) for key in todo)
    for number, (suite, seed, line) in enumerate(made, start=1):
        print(f"{number:4d}/{len(todo)}  {suite:10} {seed}", end="  ", file=sys.stderr)
        if isinstance(line, str):
            failed += 1
            print(line, file=sys.stderr)
            continue
        with path.open("a") as file:  # several commands may write it
            fcntl.flock(file, fcntl.LOCK_EX)
            file.write(json.dumps(line, separators=(",", ":"), ensure_ascii=False) + "\n")
        print(f"{score.text_of(line)} {line.get('failure', '')}  {line['processor_seconds']} s", file=sys.stderr)
    return failed


def _attempt(one: Callable[[str, int], Line], suite: str, seed: int) -> tuple[str, int, Line | str]:
    """Return a study with its line, or why it could not be drawn."""
    try:
        return suite, seed, one(suite, seed)
    except StudyFailed as e:
        return suite, seed, str(e)


def revision() -> str:
    """Return the commit of the working tree, with + for uncommitted changes."""
    changed = revisions.git("status", "--porcelain", "--untracked-files=no")
    return revisions.git("rev-parse", "--short=12", "HEAD").decode().strip() + ("+" if changed else "")


def seeds(suite: str, count: int, first: int, only: Iterable[str]) -> list[int]:
    """Return `count` consecutive seeds from `first`; with `only`, those with such a kind, plant, way or truth."""
    if not only:
        return list(range(first, first + count))
    if suite not in QUICK:
        return []

    def wanted(seed: int) -> bool:
        known = QUICK[suite](seed)
        return not {*map(str, known.values()), *known.get("truth", ())}.isdisjoint(only)

    return list(itertools.islice(filter(wanted, range(first, first + FAR)), count))


def conduct_here(suite: str, seed: int, refiner: Refiner, of_revision: str) -> Line:
    """Return the line of a study, with all of its answer."""
    told, line = conduct(suite, seed, refiner)
    return {"study": f"{seed:05d}", "revision": of_revision} | told | line


def main(arguments: Sequence[str] | None = None) -> int:
    # an installed `cosim` may differ from this working tree
    command = f"{shlex.quote(sys.executable)} -m cosim refine {{study}} --out {{out}}"
    parser = argparse.ArgumentParser(prog="python -m tests.blind.harness", description=__doc__.splitlines()[0])
    parser.add_argument("count", type=int, metavar="N", help="how many studies of each half")
    parser.add_argument("--half", choices=HALVES, default="both", help="the laboratory, the field, or both")
    parser.add_argument("--jobs", type=int, default=1, help="studies at a time (seconds are honest with 1)")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="kinds, plants, ways, laboratory effects")
    parser.add_argument("--first", type=int, default=0, help="first seed; develop on others than you report")
    options = parser.parse_args(arguments)
    if options.count < 1 or options.jobs < 1 or options.first < 0:
        parser.error("N and --jobs are at least 1, --first at least 0")
    halves, of_revision = HALVES[options.half], revision()
    chosen = {half: seeds(half, options.count, options.first, options.only) for half in halves}
    if not any(chosen.values()):
        parser.error(f"no study of {options.half} has {', '.join(options.only)}")
    refiner = partial(refine_by, command, TIMEOUT)
    one = partial(conduct_here, refiner=refiner, of_revision=of_revision)
    lines, summaries = {}, {}
    for half in halves:
        todo = [(half, seed) for seed in chosen[half]]
        have = read(RESULTS, of_revision)
        missing = [key for key in todo if key not in have or have[key]["verdict"] == "failed"]
        run(missing, one, RESULTS, options.jobs)
        have = read(RESULTS, of_revision)
        lines[half] = [have[key] for key in todo]
    for half, judged in lines.items():
        print(score.table(half, judged), end="\n\n")
        summaries[half] = score.summary(half, judged)
    print(json.dumps(summaries.pop(LABORATORY, {}) | summaries))
    return 0


if __name__ == "__main__":
    sys.exit(main())
