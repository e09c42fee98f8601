"""Location of events in model exchange, and slopes by differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cosim.blocks.derivatives import slopes_at
from cosim.blocks.solvers import SolveIvp


class Falling:
    """x' = −1 from 1; the indicator is x − 0.25."""

    x = t = 0.0

    def getContinuousStates(self, where: Any, count: int) -> None:
        where[0] = self.x

    def setContinuousStates(self, where: Any, count: int) -> None:
        self.x = where[0]

    def getDerivatives(self, where: Any, count: int) -> None:
        where[0] = -1.0

    def getNominalsOfContinuousStates(self, where: Any, count: int) -> None:
        where[0] = 1.0

    def getEventIndicators(self, where: Any, count: int) -> None:
        where[0] = self.x - 0.25

    def setTime(self, t: float) -> None:
        self.t = t


def test_solve_ivp_stops_just_behind_the_crossing() -> None:
    fmu = Falling()
    fmu.x = 1.0
    solver = SolveIvp(fmu, states=1, indicators=1, start=0.0, longest=0.1, tolerance=1e-8)
    time = 0.0
    while time < 0.5:
        event, _, time = solver.step(time, 0.5)
        assert not event
    assert fmu.x == pytest.approx(0.5)
    while not event:
        event, _, time = solver.step(time, 1.0)
    assert 0.75 <= time < 0.75 + 1e-9
    assert fmu.x <= 0.25  # the indicator is not positive any more
    assert solver.step(time, 1.0)[0] is False
    without = SolveIvp(Falling(), states=0, indicators=0, start=0.0, longest=0.5, tolerance=1e-8)
    assert without.step(0.0, 1e-4)[0] is False


# -- slopes -----------------------------------------------------------------------------------------


class Bent:
    """x' = x² u, y = x + 3 u: its slopes are 2 x u, x², 1 and 3."""

    name = "m"

    def __init__(self) -> None:
        self.asked: list[list[float]] = []

    def move(self, t: float, states: Any, inputs: Any) -> Any:
        return states

    def rates(self, states: Any, inputs: Any) -> Any:
        (x,), (u,) = states, inputs
        self.asked.append([float(x), float(u)])
        return np.array([x * x * u, x + 3.0 * u])

    def directional_slopes(self) -> Any:
        return np.array([[7.0, 7.0], [7.0, 7.0]])


@pytest.mark.parametrize(("x", "u"), [(0.5, -0.25), (4.0, 100.0)])
def test_slopes_are_central_differences_by_a_share_of_the_value_or_of_one(x: float, u: float) -> None:
    block: Any = Bent()
    slopes, here, after = slopes_at(block, 0.0, np.array([x]), np.array([u]), 1e-3, directional=False)
    assert slopes == pytest.approx(np.array([[2 * x * u, x * x], [1.0, 3.0]]), rel=1e-9)
    assert here == pytest.approx([x * x * u, x + 3.0 * u])
    assert after.tolist() == [x]
    size_x, size_u = 1e-3 * max(1.0, abs(x)), 1e-3 * max(1.0, abs(u))
    asked = [[x, u], [x + size_x, u], [x - size_x, u], [x, u + size_u], [x, u - size_u], [x, u]]
    assert np.array(block.asked) == pytest.approx(np.array(asked))
    assert slopes_at(block, 0.0, np.array([x]), np.array([u]), 1e-3, directional=True)[0].tolist() == [[7, 7], [7, 7]]
