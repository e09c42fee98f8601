"""Propagation of deviations from a free run, estimated from its responses to start states or pulses of inputs."""

from __future__ import annotations

import math

import numpy as np

from cosim.core.arrays import Array
from cosim.core.linear_algebra import least_squares, likely_least_squares

HIDDEN, EXACT = 1.5, 1e-6  # fall of ln squared errors from which a state is hidden; share of the squared change
MOST_ROWS, EACH = 10000, 10  # rows of responses to estimate what depends on the place, and least rows of a coefficient
WINDOWS = 20  # predictions of a response, each from true deviations


def propagations(responses: Array, run: Array) -> Array:
    """Return Φ and Ψ of δ⁺ = Φ·δ + Ψ·δ⁻, the deviations of the outputs of a free run, side by side for each row.

    Any small deviation obeys the same dynamics. Φ and Ψ are their least-squares estimates. An output of which the row
    before tells a hidden state, e.g. the velocity of a position, has a column in Ψ; the others have zeros there. Where
    they then predict whole responses better, Φ and Ψ depend on where the run is, with all squares of its outputs
    and their changes: a pendulum swings faster near the bottom. Growing deviations are scaled to lasting ones. Without
    responses, both are 0.

    Args:
        responses: Deviations of the outputs (rows, outputs, responses), possibly without the first rows.
        run: Outputs of the run from which they deviate (rows, outputs).
    """
    rows, (_, outputs, count) = len(run), responses.shape
    whole = np.zeros((rows, outputs, 2 * outputs))
    if not count:
        return whole
    size = np.sqrt(np.mean(responses**2, axis=(0, 2)))
    size[size == 0.0] = 1.0
    scaled = responses / size[:, None]
    scaled = scaled / np.maximum(np.sqrt(np.sum(scaled**2, axis=(0, 1))), np.finfo(float).tiny)
    parts = scaled.transpose(0, 2, 1)
    now, before, after = (part.reshape(-1, outputs) for part in (parts[1:-1], parts[:-2], parts[2:]))
    chosen, matrix = _with_hidden_states(now, before, after)
    columns = [*range(outputs), *(outputs + j for j in chosen)]
    whole[:, :, columns] = matrix
    longest = np.vstack([whole[0], np.eye(outputs, 2 * outputs)])
    growth = max(1.0, float(np.abs(np.linalg.eigvals(longest)).max()))
    by_place = whole.copy()
    by_place[:, :, columns] += _by_place(run, count, np.hstack([now, before[:, chosen]]), after, matrix)
    if _misses(by_place, scaled) < _misses(whole, scaled):
        whole = by_place
    powers = np.repeat([growth, growth**2], outputs)
    return np.asarray(whole / powers * size[:, None] / np.tile(size, 2))


def lasting(matrices: Array) -> Array:
    """Return matrices with deviations that grow in some row scaled to lasting ones; one matrix for all rows stays."""
    if (matrices == matrices[:1]).all():
        return matrices
    rows, outputs, width = matrices.shape
    both = np.concatenate([matrices, np.broadcast_to(np.eye(outputs, width), (rows, outputs, width))], axis=1)
    growth = np.maximum(1.0, np.abs(np.linalg.eigvals(both)).max(axis=1))[:, None]
    return np.asarray(matrices / np.repeat(np.hstack([growth, growth**2]), outputs, axis=1)[:, None, :])


def _misses(matrices: Array, responses: Array) -> float:
    """Return the sum over outputs of the ln squared error of predicted responses, relative to the responses.

    Each of some windows begins with true deviations. Where hardly anything deviates any more, no single row shows that
    a matrix is wrong; a prediction over many rows does, since there it grows.
    """
    matrices = matrices[len(matrices) - len(responses) :]
    predicted, before, now = responses.copy(), responses[0], responses[0]
    begins = set(np.linspace(1, len(responses) - 1, WINDOWS, endpoint=False).astype(int))
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(1, len(responses) - 1):
            if k in begins:
                before, now = responses[k - 1], responses[k]
            before, now = now, matrices[k] @ np.vstack([now, before])
            predicted[k + 1] = now
        errors = np.sum((predicted - responses) ** 2, axis=(0, 2))
    shares = errors / np.maximum(np.sum(responses**2, axis=(0, 2)), np.finfo(float).tiny)
    return float(np.log(np.maximum(np.where(np.isfinite(shares), shares, np.inf), EXACT)).sum())


def _by_place(run: Array, count: int, known: Array, after: Array, matrix: Array) -> Array:
    """Return what is to be added in each row of a run to a matrix from `known` to `after`; 0 without enough rows.

    Most places see few directions of deviations. The prior of the coefficients leaves the matrix as it is in all
    others.

    Args:
        count: Number of responses, each of which has a row of `known` for every row of the run but the ends.
    """
    outputs, rows, told = run.shape[1], len(run), len(known) // count
    nothing = np.zeros((rows, *matrix.shape))
    every = math.ceil(len(known) / MOST_ROWS) or 1
    coefficients = known.shape[1] * math.comb(2 * outputs + 2, 2)
    if len(known) < EACH * every * coefficients or not np.isfinite(run).all():
        return nothing
    left = after - known @ matrix.T
    at = np.hstack([run, np.diff(run, axis=0, prepend=run[:1])])
    at = (at - at.mean(axis=0)) / np.maximum(at.std(axis=0), np.finfo(float).tiny)
    one, other = np.triu_indices(2 * outputs)
    basis = np.hstack([np.ones((rows, 1)), at, at[:, one] * at[:, other]])
    some = np.repeat(np.arange(told) % every == 0, count)
    used, known, left = np.repeat(np.arange(rows - 1 - told, rows - 1), count)[some], known[some], left[some]
    terms = (basis[used][:, :, None] * known[:, None, :]).reshape(len(known), -1)
    added = likely_least_squares(terms, left)
    return np.asarray(np.einsum("rb,bko->rok", basis, added.reshape(basis.shape[1], -1, outputs)))


def _with_hidden_states(now: Array, before: Array, after: Array) -> tuple[list[int], Array]:
    """Return the outputs whose previous row shows a hidden state, and the matrix from `now` and these to `after`.

    Outputs are added one by one as long as the next row is predicted far better; of equally good ones, the output that
    was predicted worst so far.
    """
    change = np.sum((after - now) ** 2, axis=0)
    change[change == 0.0] = 1.0

    def regression(chosen: list[int]) -> tuple[Array, Array]:
        known = np.hstack([now, before[:, chosen]])
        matrix = least_squares(known, after, rcond=1e-8)
        left = np.sum((after - known @ matrix) ** 2, axis=0) / change
        return matrix.T, np.log(np.maximum(left, EXACT))

    chosen: list[int] = []
    matrix, left = regression(chosen)
    while rest := [j for j in range(now.shape[1]) if j not in chosen]:
        trials = {j: regression([*chosen, j]) for j in rest}
        best = min(rest, key=lambda j: (float(trials[j][1].sum()), -left[j]))
        if left.sum() - trials[best][1].sum() < HIDDEN:
            break
        chosen.append(best)
        matrix, left = trials[best]
    return chosen, matrix
