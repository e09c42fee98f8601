"""A kernel need not have been generated: one written by hand filters, and is fitted, as the generated one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from cosim.arrays import Array
from cosim.kernel.interface import Data, Filtered, Kernel, Layout, Simulated
from cosim.logs.log import Log
from cosim.refinement.candidates import Free
from cosim.refinement.fit import fit
from cosim.refinement.problem import Problem, build_problem
from plant.model import Equations, Model, Number, Values
from plant.namespaces import Namespace
from plant.quantities import Quantity, parameter

STEP, TAU, NOISE = 0.1, 1.6, 0.02


@dataclass(frozen=True, kw_only=True)
class Oven(Model):
    """A temperature that follows its heating: τ·dT/dt = u − T."""

    base_states = (Quantity("temperature", "K", "above the room"),)
    inputs = (Quantity("heating", "K", "temperature in the end"),)
    outputs = base_states
    sensor_variance = {"temperature": NOISE**2}  # noqa: RUF012 - a ClassVar of the base
    start_variance = {"temperature": 1.0}  # noqa: RUF012
    forced = ("temperature",)
    calibrated = ("tau",)
    rate, substep = STEP, STEP / 4

    tau: float = parameter(1.0, unit="s", bounds=(0.1, 10), doc="time constant")

    def equations(self, m: Namespace) -> Equations:
        """As above."""

        def derivative(t: Number, state: Values, command: Values) -> Values:
            return ((command[0] - state[0]) / self.tau,)

        return Equations(derivative, lambda t, state, command: state)


class ByHand:
    """The same filter in scalars; its layout is written down, not printed."""

    layout = Layout(("tau",), ("temperature",), ("heating",), ("temperature",), (0,), (0,))

    def run(self, data: Data, p: Array, x0: Array, P0: Array, q: Array, r: Array, *, states: bool = False) -> Filtered:
        rows = len(data.u)
        errors, variances, filtered = np.full((rows, 1), np.nan), np.full((rows, 1), np.nan), np.zeros((rows, 1))
        x, P = float(x0[0]), float(P0[0, 0])
        for k in range(rows):
            if k:
                x = self._ahead(data, p, x, k)
                P = P0[0, 0] if k <= data.settle else self._transition(data, p) ** 2 * P + q[0] * data.step
            if math.isfinite(data.y[k, 0]):
                errors[k], variances[k] = data.y[k, 0] - x, P + r[0]
                x, P = x + P / (P + r[0]) * (data.y[k, 0] - x), P - P * P / (P + r[0])
            filtered[k] = x
        return Filtered(errors, variances, filtered if states else filtered[:0], np.zeros((rows if states else 0, 0)))

    def simulate(
        self, data: Data, p: Array, x0: Array, memory: Array, kicks: Array | None = None, *, first: int = 0
    ) -> Simulated:
        rows = len(data.u)
        states = np.full((rows, 1), np.nan)
        states[first] = x0
        for k in range(first + 1, rows):
            states[k] = self._ahead(data, p, float(states[k - 1, 0]), k) + (0.0 if kicks is None else kicks[k])
        return Simulated(states.copy(), states, np.zeros((rows, 0)))

    @staticmethod
    def _ahead(data: Data, p: Array, x: float, k: int) -> float:
        """A row further by RK4: of a linear equation the series of the exponential, to the fourth order."""
        z, u = -data.step / data.substeps / p[0], float(data.u[k - 1, 0])
        grown = 1.0 + z + z**2 / 2 + z**3 / 6 + z**4 / 24
        return float(u + (x - u) * grown**data.substeps)

    @staticmethod
    def _transition(data: Data, p: Array) -> float:
        """Φ = 1 + z + z²/2 + z³/6 a substep."""
        z = -data.step / data.substeps / p[0]
        return float((1.0 + z + z**2 / 2 + z**3 / 6) ** data.substeps)


@pytest.fixture(scope="module")
def log() -> Log:
    """30 s of an oven with another time constant, by the exact solution; every third reading is missing."""
    rng = np.random.default_rng(5)
    time = STEP * np.arange(301, dtype=np.float64)
    heating = np.repeat(rng.uniform(-1, 1, 31), 10)[:301]
    temperature = np.zeros(301)
    for k in range(300):
        temperature[k + 1] = heating[k] + (temperature[k] - heating[k]) * math.exp(-STEP / TAU)
    read = temperature + NOISE * rng.standard_normal(301)
    read[2::3] = np.nan
    units = {"heating": "K", "temperature": "K"}
    return Log(Path("oven.csv"), time, {"heating": heating}, {"temperature": read}, units, STEP, units, {})


@pytest.fixture(scope="module")
def problems(log: Log) -> dict[str, Problem]:
    generated = build_problem(Oven(), [log])
    kernel: Kernel = ByHand()
    written = replace(generated, kernel=kernel)
    return {"generated": generated, "written": written}


def test_both_have_one_layout(problems: dict[str, Problem]) -> None:
    assert problems["written"].layout == problems["generated"].layout
    assert problems["written"].layout.forced == ("temperature",)


@pytest.mark.parametrize(
    "call",
    [
        lambda p: p.run({"tau": 1.3}, np.array([-6.0]), 0, states=True),
        lambda p: p.kernel.simulate(p.logs[0], np.array([1.3]), np.array([0.4]), np.zeros(0), first=7),
    ],
    ids=["filter", "simulate"],
)
def test_both_give_the_same_numbers(problems: dict[str, Problem], call: Callable[[Problem], object]) -> None:
    one, other = (vars(call(p)) for p in problems.values())
    for name, values in one.items():
        # sums in another order, over 300 rows of numbers about 1
        np.testing.assert_allclose(other[name], values, rtol=1e-10, atol=1e-12, err_msg=name)


def test_a_fit_on_either_finds_the_same_time_constant(problems: dict[str, Problem]) -> None:
    free = [Free("tau", 0.1, 10.0, 0.1)]
    fits = [fit(p, free, p.values, p.noise.plain) for p in problems.values()]
    assert fits[1].values["tau"] == pytest.approx(fits[0].values["tau"], rel=1e-6)
    assert abs(fits[0].values["tau"] - TAU) < 4.0 * fits[0].sigma("tau")
