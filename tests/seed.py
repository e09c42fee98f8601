"""The slow rows of docs/seed.md: `python -m tests.seed [SEEDS]` prints how often intervals hold the truth.

Then the five tests by `cosim identify` for five seeds, and the whole way of
examples/bench/overshoot: logs of the bench, refined, the craft flown before and after.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

import cosim
from plant.identification.estimates import Result
from plant.identification.protocol import Protocol, read_protocol
from plant.identification.recordings import Recording, calibrate, load_runs, play, runs_of
from plant.identification.workflow import analyse

PROTOCOL = Path(__file__).resolve().parent.parent / "examples" / "bench" / "protocol.yaml"
LEAST, MOST = 0.90, 0.99  # of 200 intervals of 95 %
AT_ONCE = 20  # seeds


def coverage(path: Path, seeds: Sequence[int]) -> pd.DataFrame:
    """Means over seeds of every estimate, the simulated bench being the truth; `held`: share of intervals."""
    protocol, rows = read_protocol(path), []
    for first in range(0, len(seeds), AT_ONCE):
        for result in simulated(protocol, seeds[first : first + AT_ONCE]):
            for e in result.estimates:
                half = 0.5 * (e.high - e.low)
                rows.append((f"{result.test}.{e.name}", e.unit, e.truth, e.value, half, e.thesis, e.covers_truth))
        print(f"{min(first + AT_ONCE, len(seeds))} of {len(seeds)} seeds", file=sys.stderr, flush=True)
    names = ["number", "unit", "true", "unbiased", "half", "thesis", "held"]
    return pd.DataFrame(rows, columns=names).groupby(["number", "unit"], sort=False).mean().reset_index()


def simulated(protocol: Protocol, seeds: Sequence[int]) -> Iterator[Result]:
    """Yield the results of a protocol for each seed; equal runs share a simulation."""

    def recorded(groups: Mapping[Any, Sequence[Recording]]) -> dict[Any, list[Recording]]:
        batch = iter(play(protocol.bench, [run for runs in groups.values() for run in runs]))
        return {key: [next(batch) for _ in runs] for key, runs in groups.items()}

    names = [name for name, _ in protocol.file.tests.named_tests()]
    hung = recorded({(seed, cell): runs for seed in seeds for cell, runs in load_runs(protocol, seed).items()})
    tests = recorded({(seed, name): runs_of(protocol, name, seed) for seed in seeds for name in names})
    for seed in seeds:
        cells = calibrate(protocol, {cell: runs for (of, cell), runs in hung.items() if of == seed})
        yield from analyse(protocol, cells, {name: tests[seed, name] for name in names})


def main(seeds: int) -> int:
    """Print the table; 1 where a share of seeds is outside its limits (of fewer than 100, below the lower one)."""
    rows = coverage(PROTOCOL, range(1, seeds + 1))
    head = f"{'number':38}{'unit':>6}{'true':>12}{'unbiased':>12}{'± 95 %':>11}{'thesis':>12}{'held in':>9}"
    print(head, f" ({seeds} seeds)")
    for name, unit, true, unbiased, half, thesis, held in rows.itertuples(index=False):
        print(f"{name:38}{unit:>6}{true:>12.5g}{unbiased:>12.5g}{half:>11.3g}{thesis:>12.5g}{100 * held:>8.1f} %")
    outside = rows.number[~rows.held.between(LEAST, MOST if seeds >= 100 else 1.0)]
    print(f"outside {LEAST:.0%} … {MOST:.0%}: {', '.join(outside) or 'none'}")
    return int(any([len(outside), played(), overshoot()]))


def played(seeds: int = 5) -> bool:
    """Print how many intervals of `cosim identify` hold the truth; whether fewer than 90 %."""
    held, made = 0, 0
    for seed in range(1, seeds + 1):
        with tempfile.TemporaryDirectory() as folder:
            estimates = cosim.identify(PROTOCOL, folder, report=False, seed=seed).estimates.values()
        missed = [e.name for e in estimates if not e.covers_truth]
        held, made = held + len(estimates) - len(missed), made + len(estimates)
        print(f"seed {seed}: {len(estimates) - len(missed)} of {len(estimates)} hold the truth", *missed)
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
