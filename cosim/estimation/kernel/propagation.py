"""Propagation of deviations from a free run, estimated from its responses to start states or pulses of inputs."""

from __future__ import annotations

import numpy as np

from cosim.core.arrays import Array
from cosim.core.linear_algebra import least_squares

HIDDEN, EXACT = 1.5, 1e-6  # fall of ln squared errors from which a state is hidden; share of the squared change


def propagation(responses: Array) -> Array:
    """Return Φ and Ψ of δ⁺ = Φ·δ + Ψ·δ⁻, the deviations of the outputs of a free run, side by side.

    Any small deviation obeys the same dynamics. Φ and Ψ are their least-squares estimates. An output of which the row
    before tells a hidden state, e.g. the velocity of a position, has a column in Ψ; the others have zeros there.
    Growing deviations are scaled to lasting ones. Without responses, both are 0.

    Args:
        responses: Deviations of the outputs (rows, outputs, responses).
    """
    _, outputs, count = responses.shape
    whole = np.zeros((outputs, 2 * outputs))
    if not count:
        return whole
    size = np.sqrt(np.mean(responses**2, axis=(0, 2)))
    size[size == 0.0] = 1.0
    scaled = responses / size[:, None]
    scaled = scaled / np.maximum(np.sqrt(np.sum(scaled**2, axis=(0, 1))), np.finfo(float).tiny)
    parts = scaled.transpose(0, 2, 1)
    chosen, matrix = _with_hidden_states(*(part.reshape(-1, outputs) for part in (parts[1:-1], parts[:-2], parts[2:])))
    whole[:, [*range(outputs), *(outputs + j for j in chosen)]] = matrix
    growth = max(1.0, float(np.abs(np.linalg.eigvals(np.vstack([whole, np.eye(outputs, 2 * outputs)]))).max()))
    return np.asarray(whole / np.repeat([growth, growth**2], outputs) * size[:, None] / np.tile(size, 2))


def _with_hidden_states(now: Array, before: Array, after: Array) -> tuple[list[int], Array]:
    """Return the outputs whose previous row shows a hidden state, and the matrix from `now` and these to `after`.

    Outputs are added one by one as long as the next row is predicted far better; of equally good ones, the output that
    was predicted worst so far.
    """
    change = np.sum((after - now) ** 2, axis=0)
    change[change == 0.0] = 1.0

    def regression(chosen: list[int]) -> tuple[Array, Array]:
        known = np.hstack([now, before[:, chosen]])
        matrix = least_squares(known, after, rcond=float(np.sqrt(np.finfo(float).eps)))
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
