"""Claims of blind studies repeated with other stated noise: absent, as the model's, a third, threefold.

    python -m tests.blind.same_claims 12 --half field --first 400 --results /tmp/same.jsonl [--jobs 2]

A study counts as the same if all four verdicts claim the same names. Studies with a line in the results are skipped.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from cosim.refinement.study import read_study
from tests.blind.field_score import put_forward
from tests.blind.harness import HALVES, Refiner, command_refiner, conduct, default_command
from tests.blind.score import wilson

FACTORS = {"absent": None, "stated": 1.0, "third": 1.0 / 3.0, "threefold": 3.0}


def with_noise(refiner: Refiner, factor: float | None) -> Refiner:
    """Return a refiner that reads the study with the model's sensor noise, times a factor, under `noise:`."""

    def refine(study: Path, out: Path) -> None:
        if factor is not None:
            variances = read_study(study).subject.sensor_variance
            levels = {name: factor * variance**0.5 for name, variance in variances.items()}
            study.write_text(f"{study.read_text()}noise: {json.dumps(levels)}\n")
        refiner(study, out)

    return refine


def repeat(seed: int, refiner: Refiner, half: str) -> dict[str, Any]:
    """Return the verdict and the claimed names of a study under each noise."""
    answers = {}
    for name, factor in FACTORS.items():
        line = conduct(seed, with_noise(refiner, factor), half)
        answers[name] = {"verdict": line["verdict"], "names": sorted(put_forward(line)), "seconds": line["seconds"]}
    return {"half": half, "seed": seed, "truth": sorted(line["truth"]), "answers": answers}


def is_same(line: dict[str, Any]) -> bool:
    """Return whether all verdicts on a study claim the same names, wholly or in part."""
    return len({tuple(answer["names"]) for answer in line["answers"].values()}) == 1


def main(arguments: Sequence[str] | None = None) -> int:
    """Repeat the studies; print the share with the same claims."""
    parser = argparse.ArgumentParser(prog="python -m tests.blind.same_claims", description=__doc__)
    parser.add_argument("count", type=int, metavar="N")
    parser.add_argument("--half", choices=[half for half, of in HALVES.items() if len(of) == 1], default="field")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--results", type=Path, required=True)
    options = parser.parse_args(arguments)
    texts = options.results.read_text().splitlines() if options.results.exists() else []
    lines = {(line["half"], line["seed"]): line for line in map(json.loads, texts)}
    wanted = [(options.half, seed) for seed in range(options.first, options.first + options.count)]
    refiner = command_refiner(default_command(), 600.0)
    with ThreadPoolExecutor(options.jobs) as pool:
        todo = [pool.submit(repeat, seed, refiner, half) for half, seed in wanted if (half, seed) not in lines]
        for done in as_completed(todo):
            line = done.result()
            lines[line["half"], line["seed"]] = line
            with options.results.open("a") as file:
                file.write(json.dumps(line) + "\n")
            print(line["seed"], "same" if is_same(line) else "differs", json.dumps(line["answers"]), file=sys.stderr)
    hits = sum(is_same(lines[key]) for key in wanted)
    low, high = wilson(hits, len(wanted))
    print(f"same claims: {hits} of {len(wanted)} [{100 * low:.1f} %, {100 * high:.1f} %]")
    return 0


if __name__ == "__main__":
    sys.exit(main())
