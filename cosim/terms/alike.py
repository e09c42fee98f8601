"""Groups of terms with similar effects in many logs, each with an experiment that distinguishes them."""

from __future__ import annotations

from collections.abc import Iterable

ALIKE: tuple[tuple[frozenset[str], str], ...] = (
    (
        frozenset({"delay", "lag", "second_order_lag", "rate_limit", "latency"}),
        "steps of each input in several sizes, with five times as many rows: a delay responds late, a lag at once, "
        "and a rate limit takes longer for a larger step; in a linear plant, an input and a sensor are distinguished "
        "only by a second sensor or a measurement of the input behind the lag",
    ),
    (
        frozenset({"dead_band", "play", "coulomb", "stribeck"}),
        "slow ramps of each input through zero and back, and again with a reversal halfway: a dead band has no memory, "
        "play delays the response only at reversals, and friction prevents motion up to a threshold",
    ),
    (
        frozenset({"gain", "scale", "saturation", "square_law", "offset", "bias", "drift"}),
        "steps of each input in three sizes and both directions, with pauses at zero at the beginning and the end",
    ),
    (
        frozenset({"coulomb", "stribeck", "viscous", "quadratic_drag"}),
        "constant speeds in both directions, from creeping to the fastest, each followed by coasting to rest",
    ),
    (
        frozenset({"cubic_spring", "cogging", "offset"}),
        "slow motion over the whole travel, up and down, several times",
    ),
    (
        frozenset({"cubic_spring", "gap"}),
        "slow loads in both directions, from a hundredth of the largest to the largest deflection",
    ),
    (
        frozenset({"leak", "growing_leak", "overflow", "bias", "drift"}),
        "fill slowly to the top and drain to the bottom, each followed by a long pause",
    ),
)


# kind of term → kind that it equals at some values; an overflow at level 0 equals a leak if the level is never negative
SPECIAL_CASES = {"coulomb": "stribeck", "leak": "overflow"}


def contains(rich: str, simple: str) -> bool:
    """Return True if the term `rich` equals the term `simple` at the same place for some parameter values.

    Names have the form `kind_at_place`.
    """
    (kind, _, place), (other, _, other_place) = rich.partition("_at_"), simple.partition("_at_")
    return place == other_place and SPECIAL_CASES.get(other) == kind


def experiments_for(names: Iterable[str]) -> dict[frozenset[str], str]:
    """Return groups of similar terms → experiment that distinguishes them.

    Args:
        names: Names of all terms and sensor errors, `kind_at_place`.
    """
    every = [*names]
    rows = ((frozenset(n for n in every if n.partition("_at_")[0] in kinds), text) for kinds, text in ALIKE)
    return {row: text for row, text in rows if len(row) > 1}
