"""The slow rows of docs/seed.md: `python -m tests.seed [SEEDS]` prints how often intervals hold the truth.

By plain functions, then, for five seeds, with the five tests played on the bench's FMU. Then the whole way of
examples/bench/overshoot: logs of the bench, refined, the craft flown before and after.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import cosim
from tests.interval_coverage import coverage, table

PROTOCOL = Path(__file__).resolve().parent.parent / "examples" / "bench" / "protocol.yaml"
LEAST, MOST = 0.90, 0.99  # of 200 intervals of 95 %


def main(seeds: int) -> int:
    """Print the table; 1 where a share of seeds is outside its limits (of fewer than 100, below the lower one)."""
    rows = coverage(PROTOCOL, range(1, seeds + 1), lambda k, n: print(f"{k} of {n} seeds", file=sys.stderr, flush=True))
    print(table(rows, seeds))
    outside = [r.name for r in rows if not LEAST <= r.share <= (MOST if seeds >= 100 else 1.0)]
    print(f"outside {LEAST:.0%} … {MOST:.0%}: {', '.join(outside) or 'none'}")
    return int(any([outside, played(), overshoot()]))


def played(seeds: int = 5) -> bool:
    """Print how many intervals hold the truth where the bench's FMU is played; whether fewer than 90 %."""
    held, made = 0, 0
    for seed in range(1, seeds + 1):
        with tempfile.TemporaryDirectory() as folder:
            estimates = cosim.identify(PROTOCOL, folder, report=False, seed=seed).estimates.values()
        missed = [e.name for e in estimates if not e.covers_truth]
        held, made = held + len(estimates) - len(missed), made + len(estimates)
        print(
            f"seed {seed} through the FMU: {len(estimates) - len(missed)} of {len(estimates)} hold the truth", *missed
        )
    return held < LEAST * made


def overshoot() -> bool:
    """Print what the example finds and flies; whether it found something else."""
    from examples.bench.overshoot.fly import fly
    from examples.bench.overshoot.make_logs import make_logs

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        found = cosim.refine(make_logs(folder), folder / "refined", report=False)
        print(found.record["sentence"])
        print("\n".join(fly(folder)))
    return [e["name"] for e in found.record["effects"]] != ["actuator_second_order"]


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 200))
