"""A kernel need not have been generated: one written by hand filters, and is fitted, as the generated one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from cosim.core.arrays import Array
from cosim.estimation.kernel.kernel import DISTURBANCE, MEMORY, Data, Filtered, Kernel, Layout, Simulated
from cosim.estimation.posing import build_problem
from cosim.estimation.problem import Problem
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.logs.log import Log
from cosim.model import Equations, Model, Namespace, Number, Quantity, Values, parameter

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
    """The same filter, its matrices written down, not printed: T' = (u − T)/τ + d, d' = −d/T_d."""

    layout = Layout(
        ("tau", MEMORY),
        ("temperature", f"{DISTURBANCE}temperature"),
        ("heating",),
        ("temperature",),
        (0, 1),
        (1,),
    )

    def run(self, data: Data, p: Array, x0: Array, P0: Array, q: Array, r: Array, *, states: bool = False) -> Filtered:
        rows = len(data.u)
        errors, variances, filtered = np.full((rows, 1), np.nan), np.full((rows, 1), np.nan), np.zeros((rows, 2))
        r = np.broadcast_to(r, (rows, 1))
        x, P, Phi = np.array(x0), np.array(P0), self._series(data, p, 3)
        for k in range(rows):
            if k:
                x = self._ahead(data, p, x, k)
                P = np.array(P0) if k <= data.settle else Phi @ P @ Phi.T + np.diag(q) * data.step
            if math.isfinite(data.y[k, 0]):
                errors[k], variances[k] = data.y[k, 0] - x[0], P[0, 0] + r[k, 0]
                gain = P[:, 0] / variances[k]
                x, P = x + gain * errors[k], P - np.outer(gain, P[0])
            filtered[k] = x
        return Filtered(errors, variances, filtered if states else filtered[:0], np.zeros((rows if states else 0, 0)))

    def simulate(
        self, data: Data, p: Array, x0: Array, memory: Array, kicks: Array | None = None, *, first: int = 0
    ) -> Simulated:
        rows = len(data.u)
        states = np.full((rows, 2), np.nan)
        states[first] = x0
        for k in range(first + 1, rows):
            states[k] = self._ahead(data, p, states[k - 1], k) + (0.0 if kicks is None else kicks[k])
        return Simulated(states[:, :1].copy(), states, np.zeros((rows, 0)))

    @classmethod
    def _ahead(cls, data: Data, p: Array, x: Array, k: int) -> Array:
        """A row further by RK4: of linear equations the series of the exponential, to the fourth order."""
        rest = np.array([float(data.u[k - 1, 0]), 0.0])
        return rest + cls._series(data, p, 4) @ (x - rest)

    @staticmethod
    def _series(data: Data, p: Array, order: int) -> Array:
        """Φ = 1 + z + z²/2 + … a substep."""
        z = data.step / data.substeps * np.array([[-1.0 / p[0], 1.0], [0.0, -1.0 / p[1]]])
        once = sum((np.linalg.matrix_power(z, n) / math.factorial(n) for n in range(order + 1)), np.zeros((2, 2)))
        return np.linalg.matrix_power(once, data.substeps)


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
    generated = build_problem(ModelSubject.of(Oven()), [log])
    kernel: Kernel = ByHand()
    written = replace(generated, kernel=kernel)
    return {"generated": generated, "written": written}


@pytest.mark.parametrize(
    "call",
    [
        lambda p: p.run({"tau": 1.3}, p.at(np.array([-6.0])), 0, states=True),
        lambda p: p.kernel.simulate(p.logs[0], np.array([1.3, 0.15]), np.array([0.4, 0.1]), np.zeros(0), first=7),
    ],
    ids=["filter", "simulate"],
)
def test_both_give_the_same_numbers(problems: dict[str, Problem], call: Callable[[Problem], object]) -> None:
    one, other = (vars(call(p)) for p in problems.values())
    for name, values in one.items():
        if name == "covariances":  # which a kernel may leave out
            continue
        # sums in another order, over 300 rows of numbers about 1
        np.testing.assert_allclose(other[name], values, rtol=1e-10, atol=1e-12, err_msg=name)
