"""Points without a derivative: the one-sided slopes differ, as at the edge of a dead band or a stop."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cosim.base.arrays import Array

STEP = 1e-6  # step of one-sided slopes relative to each state and input, or to 1
MAX_SLOPE_CHANGE = 1e-3  # across a smooth point, relative to the largest slope in a row
REFINEMENT = 10.0  # division of the step for the second test
STEPS_OFF_KINK = 3.0  # from the kink to the one-sided slopes
SIDES = {"below": -1.0, "above": 1.0}
RATE, OUTPUT = "rate", "output"


@dataclass(frozen=True)
class KinkSlopes:
    """One-sided slopes of a derivative or an output at a kink, and the height of the jump, 0 without one."""

    of: str
    name: str
    below: float
    above: float
    jump: float

    def __str__(self) -> str:
        subject = f"the rate of {self.name}" if self.of == RATE else f"output {self.name}"
        jump = f", and it jumps by {self.jump:.4g}" if self.jump else ""
        return f"{subject} has slope {self.below:.4g} below and {self.above:.4g} above{jump}"


@dataclass(frozen=True)
class Kink:
    """A state or input value with different one-sided slopes; `side` names the slopes in use."""

    variable: str
    value: float
    rows: tuple[KinkSlopes, ...]
    side: str = ""

    @property
    def description(self) -> str:
        """Return location and slopes in words, three rows at most."""
        rows = "; ".join(map(str, self.rows[:3]))
        more = f"; and {len(self.rows) - 3} rows more" if len(self.rows) > 3 else ""
        kind = "jump" if any(r.jump for r in self.rows) else "kink"
        return f"{self.variable} = {self.value:.6g} is a {kind}: {rows}{more}"

    def restrict(self, states: Sequence[str], outputs: Sequence[str]) -> Kink:
        """Return the kink with only these rows."""
        names = {RATE: states, OUTPUT: outputs}
        return replace(self, rows=tuple(r for r in self.rows if r.name in names[r.of]))

    def choose_side(self, slopes: Mapping[tuple[str, str], float]) -> Kink:
        """Return the kink with the side of these slopes."""

        def distance(side: str) -> float:
            return sum(abs(slopes[r.of, r.name] - float(getattr(r, side))) for r in self.rows)

        return replace(self, side=min(SIDES, key=distance))

    def as_json(self) -> dict[str, Any]:
        """Return plain data for scripts."""
        rows = [vars(r) for r in self.rows]
        return {"variable": self.variable, "value": self.value, "side": self.side, "rows": rows}


def kinks_at(
    rates: Callable[[Array], Array], z: Array, states: Sequence[str], inputs: Sequence[str], outputs: Sequence[str]
) -> list[Kink]:
    """Return the kinks at z of a function from states and inputs to rates and outputs."""
    here, kinks = rates(z), []
    rows = [*((RATE, n) for n in states), *((OUTPUT, n) for n in outputs)]
    for k, name in enumerate((*states, *inputs)):
        h = STEP * max(1.0, abs(float(z[k])))
        along = np.zeros_like(z)
        along[k] = 1.0
        up, down = rates(z + h * along), rates(z - h * along)
        ahead, behind = (up - here) / h, (here - down) / h
        size = np.maximum(np.maximum(np.abs(ahead), np.abs(behind)), 1e-6)
        bent = np.abs(ahead - behind) > MAX_SLOPE_CHANGE * size + 1e-8 * np.abs(here) / h + 1e-9 / h
        if not bent.any():
            continue
        # Closer to the point, a curve becomes straight and a kink does not.
        near = h / REFINEMENT
        up, further, down, back = (rates(z + m * near * along) for m in (1.0, 2.0, -1.0, -2.0))
        bent &= np.abs(up - 2.0 * here + down) / near > 0.5 * np.abs(ahead - behind)
        # Slopes start one step from the point, so that a jump at the point affects neither side.
        above, below = (further - up) / near, (down - back) / near
        jump = (2.0 * up - further) - (2.0 * down - back)
        jump = np.where(np.abs(jump) > 0.5 * np.abs(up - down), jump, 0.0)
        if bent.any():
            at = [KinkSlopes(*rows[i], *(float(v[i]) for v in (below, above, jump))) for i in np.flatnonzero(bent)]
            kinks.append(Kink(name, float(z[k]), tuple(at)))
    return kinks
