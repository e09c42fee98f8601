"""How often the true value lies inside the 95 % interval: a protocol by plain functions, a seed each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from plant.identification.estimates import Estimate
from tests.bench_runs import play_plain, read_protocol, simulate_seeds

AT_ONCE = 20  # seeds


@dataclass(frozen=True)
class Coverage:
    """Of one number over seeds: share of intervals that hold it, mean of both estimators, mean half-width."""

    name: str
    unit: str
    truth: float
    share: float
    value: float
    thesis: float
    half: float
    spread: float


def coverage(path: Path, seeds: Sequence[int], tell: Callable[[int, int], None] | None = None) -> list[Coverage]:
    """Return the coverage of every estimate of a protocol over seeds, with the simulated bench as truth."""
    protocol = read_protocol(path)
    play, found = play_plain(protocol.bench), dict[str, list[Estimate]]()
    for first in range(0, len(seeds), AT_ONCE):
        for results in simulate_seeds(protocol, play, seeds[first : first + AT_ONCE]):
            for test, estimate in ((r.test, e) for r in results for e in r.estimates):
                found.setdefault(f"{test}.{estimate.name}", []).append(estimate)
        if tell is not None:
            tell(min(first + AT_ONCE, len(seeds)), len(seeds))
    return [_of(key, estimates) for key, estimates in found.items()]


def _of(key: str, estimates: Sequence[Estimate]) -> Coverage:
    first, values = estimates[0], np.array([e.value for e in estimates])
    share, thesis = (
        float(np.mean([e.covers_truth for e in estimates])),
        float(np.nanmean([e.thesis for e in estimates])),
    )
    half = float(np.mean([0.5 * (e.high - e.low) for e in estimates]))
    spread = float(values.std(ddof=1)) if values.size > 1 else 0.0
    return Coverage(key, first.unit, first.truth, share, float(values.mean()), thesis, half, spread)


def table(rows: Sequence[Coverage], seeds: int) -> str:
    """As text."""
    head = f"{'number':38}{'unit':>6}{'true':>12}{'unbiased':>12}{'± 95 %':>11}{'thesis':>12}{'held in':>9}"
    head += f"  ({seeds} seeds)"
    lines = [
        f"{r.name:38}{r.unit:>6}{r.truth:>12.5g}{r.value:>12.5g}{r.half:>11.3g}{r.thesis:>12.5g}{100 * r.share:>8.1f} %"
        for r in rows
    ]
    return "\n".join([head, *lines])
