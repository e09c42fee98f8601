"""State feedback with saturation."""

from __future__ import annotations

from collections.abc import Sequence


def feedback(
    gain: Sequence[Sequence[float]], x_hat: Sequence[float], reference: Sequence[float], limit: float
) -> tuple[float, ...]:
    """Return tilt commands [rad], eq 6.1: u = sat(−K·(x̂ − x_ref), ±limit), K (2, 5)."""
    error = [a - b for a, b in zip(x_hat, reference, strict=True)]
    # Adding 0.0 turns −0.0 into 0.0, so that a craft at rest gives 0 in every file.
    return tuple(max(-limit, min(limit, -sum(k * e for k, e in zip(row, error, strict=True)))) + 0.0 for row in gain)
