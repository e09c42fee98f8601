"""Ranks of the factors of a sweep: what is proven, and how often chance passes for an influence."""

from __future__ import annotations

import numpy as np
import pytest
from SALib.analyze import pawn

from cosim.sweeps.sampling import Factor, columns_of, sensitivity

NAMES = ("steep", "bent", "wavy", "idle")


def _sweep(seed: int, runs: int) -> tuple[dict[str, list[float]], np.ndarray]:
    columns = columns_of([Factor(n, drawn=lambda u: u) for n in NAMES], runs, "latin-hypercube", seed)
    steep, bent, wavy = (np.array(columns[n]) for n in NAMES[:3])
    return columns, steep + 0.6 * bent**2 + 0.3 * np.sin(6.0 * wavy)


@pytest.mark.parametrize(("sweeps", "most"), [(25, 3), pytest.param(100, 9, marks=pytest.mark.thorough)])
def test_an_idle_factor_among_four_is_ranked_in_one_sweep_of_twenty(sweeps: int, most: int) -> None:
    found = dict.fromkeys(NAMES, 0)
    for seed in range(sweeps):
        columns, values = _sweep(seed, 64)
        result = sensitivity("y", values, columns, saltelli=False, seed=seed)
        assert result is not None
        assert set(result.ranked) == set(result.factors[: len(result.ranked)])
        for name in result.ranked:
            found[name] += 1
    assert found["idle"] <= most
    assert found["steep"] >= 0.95 * sweeps


def test_the_index_is_that_of_salib_and_equal_outcomes_have_none() -> None:
    columns, values = _sweep(3, 500)
    X = np.column_stack([columns[n] for n in NAMES])
    problem = {"num_vars": len(NAMES), "names": list(NAMES), "bounds": [[0.0, 1.0]] * len(NAMES)}
    theirs = dict(zip(NAMES, pawn.analyze(problem, X, values, S=5)["mean"], strict=True))
    ours = sensitivity("y", values, columns, saltelli=False, seed=3)
    assert ours is not None
    # SALib leaves the largest value of a factor out of its last slice
    assert dict(zip(ours.factors, ours.pawn, strict=True)) == pytest.approx(theirs, abs=0.01)
    assert {*ours.ranked} == {"steep", "bent", "wavy"}
    assert sensitivity("y", np.full(500, 2.0), columns, saltelli=False, seed=3) is None
