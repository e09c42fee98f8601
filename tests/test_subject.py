"""A refinable object that never was a `Model`: a mass on rails, written by hand in Python, with its own filter.

m·v' = g·u − c·v − F·tanh(v/ε) + m·d        d' = −d/T + w
"""

from __future__ import annotations

import json
import math
from collections.abc import Generator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest

import cosim
from cosim.core.arrays import Array
from cosim.core.errors import InputError
from cosim.estimation.kernel.kernel import CORRELATION_TIME, DISTURBANCE, Data, Filtered, Kernel, Layout, Simulated
from cosim.estimation.subject.candidates import Candidate, base_parameter, effect
from cosim.estimation.subject.interface import Replayer, Start, Subject, Workplace
from cosim.logs.log import Log
from cosim.model import Quantity, parameter
from cosim.model.quantities import Parameter
from cosim.refinement.study import study_of
from cosim.residuals.windows import Replay
from cosim.verbs.checks import schema_of
from tests.logs import integrated, times, write_log

STEP, MASS, VISCOUS, FORCE, SOFT, NOISE = 0.05, 2.0, 0.8, 0.9, 0.05, 1e-3
Pair = tuple[float, float]


def row_ahead(p: Mapping[str, float], state: Pair, u: float, h: float, substeps: int) -> tuple[Pair, Array]:
    """Speed and unknown input a row further by RK4, and exp(A·h) of third order, A = [[s, 1], [0, −1/T]]."""
    push, drag, dry = (value / p["mass"] for value in ((1.0 + p["gain.excess"]) * u, p["viscous"], p["coulomb.force"]))

    def rates(v: float, d: float) -> Pair:
        return push - drag * v - dry * math.tanh(v / SOFT) + d, -d / p[CORRELATION_TIME]

    (v, d), Phi = state, np.eye(2)
    for _ in range(substeps):
        slope = drag + dry * (1.0 - math.tanh(v / SOFT) ** 2) / SOFT
        Ah = h * np.array([[-slope, 1.0], [0.0, -1.0 / p[CORRELATION_TIME]]])
        Phi += Ah @ (Phi + Ah @ (Phi + Ah @ Phi / 3.0) / 2.0)
        a1, b1 = rates(v, d)
        a2, b2 = rates(v + 0.5 * h * a1, d + 0.5 * h * b1)
        a3, b3 = rates(v + 0.5 * h * a2, d + 0.5 * h * b2)
        a4, b4 = rates(v + h * a3, d + h * b3)
        v += h * (a1 + 2.0 * (a2 + a3) + a4) / 6.0
        d += h * (b1 + 2.0 * (b2 + b3) + b4) / 6.0
    return (v, d), Phi


class RailKernel:
    """An extended Kalman filter of speed and unknown input."""

    layout = Layout(
        ("mass", "viscous", "coulomb.force", "gain.excess", CORRELATION_TIME),
        ("speed", f"{DISTURBANCE}speed"),
        ("push",),
        ("speed",),
        stochastic=(0, 1),
        noisy=(1,),
    )

    def run(self, data: Data, p: Array, x0: Array, P0: Array, q: Array, r: Array, *, states: bool = False) -> Filtered:
        rows, numbers = len(data.u), dict(zip(self.layout.parameters, p.tolist(), strict=True))
        errors, variances, filtered = np.full((rows, 1), np.nan), np.full((rows, 1), np.nan), np.zeros((rows, 2))
        x, P, noise = x0, P0, np.broadcast_to(r, (rows, 1))
        for k in range(rows):
            if k:
                ahead, Phi = row_ahead(
                    numbers, tuple(x.tolist()), float(data.u[k - 1, 0]), data.step / data.substeps, data.substeps
                )
                x, P = np.array(ahead), P0 if k <= data.settle else Phi @ P @ Phi.T + np.diag(q) * data.step
            if math.isfinite(data.y[k, 0]):
                errors[k], variances[k] = data.y[k, 0] - x[0], P[0, 0] + noise[k]
                gain = P[:, 0] / variances[k]
                x, P = x + gain * errors[k], P - np.outer(gain, P[0])
            filtered[k] = x
        return Filtered(errors, variances, filtered if states else filtered[:0], np.zeros((rows if states else 0, 0)))

    def simulate(
        self, data: Data, p: Array, x0: Array, memory: Array, kicks: Array | None = None, *, first: int = 0
    ) -> Simulated:
        rows, numbers = len(data.u), dict(zip(self.layout.parameters, p.tolist(), strict=True))
        states = np.full((rows, 2), np.nan)
        states[first] = x0
        for k in range(first + 1, rows):
            ahead, _ = row_ahead(
                numbers, tuple(states[k - 1]), float(data.u[k - 1, 0]), data.step / data.substeps, data.substeps
            )
            states[k] = np.array(ahead) + (0.0 if kicks is None else kicks[k])
        return Simulated(states[:, :1].copy(), states, np.zeros((rows, 0)))


class RailReplayer(Replayer):
    """Runs of the mass itself from the states that a filter knew."""

    through = "own"

    def replays(
        self, log: Log, data: Data, values: Mapping[str, float], starts: Mapping[float, Mapping[int, Start]]
    ) -> Generator[Replay, None, None]:
        for horizon, begins in starts.items():
            speed, span = np.full(log.rows, np.nan), min(log.rows, horizon / log.step)
            for k, start in begins.items():
                state = start.states["speed"], 0.0
                for row in range(k + 1, min(log.rows, k + round(span) + 1)):
                    push = float(log.inputs["push"][row - 1])
                    state, _ = row_ahead({**values, CORRELATION_TIME: 1.0}, state, push, log.step / 4, 4)
                    speed[row] = state[0]
            yield Replay(horizon, {k: dict(start.states) for k, start in begins.items()}, {"speed": speed})


def number(name: str, default: float, unit: str, doc: str, **more: float | tuple[float, float]) -> Parameter:
    return replace(parameter(default, unit=unit, doc=doc, **more).metadata["parameter"], name=name)


OWN = (
    number("mass", MASS, "kg", "of all that moves", bounds=(0.1, 10.0), tolerance=0.05),
    number("viscous", VISCOUS, "N.s/m", "friction of the bearings", bounds=(0.0, 5.0), tolerance=0.1),
)
TERMS = {
    "coulomb": number("force", 0.0, "N", "dry friction", bounds=(0.0, 5.0), neutral=0.0, typical=0.3),
    "gain": number("excess", 0.0, "1", "of the push", bounds=(-0.9, 5.0), neutral=0.0, typical=0.2),
}


class Rail(Subject):
    """The mass on rails as something that can be refined."""

    title = "Mass on rails"
    inputs = (Quantity("push", "N", "force on it"),)
    states = outputs = (Quantity("speed", "m/s", "along the rails"),)
    horizon, rate = 2.0, STEP
    parameters = OWN
    candidate_parameters = {f"{name}.{p.name}": p for name, p in TERMS.items()}  # noqa: RUF012
    sensor_variance = {"speed": NOISE**2}  # noqa: RUF012
    start_variance = {"speed": 1.0}  # noqa: RUF012

    def __init__(self, claims: Mapping[str, float] | None = None) -> None:
        self.values = {**{n: float(p.default) for n, p in self.declared.items()}, **(claims or {})}
        self.present = frozenset(n for n, p in TERMS.items() if self.values[f"{n}.{p.name}"])

    def candidates(self, varied: Sequence[str]) -> list[Candidate]:
        terms = [effect(name, [p], self.values) for name, p in TERMS.items()]
        wrong = [
            Candidate(
                p.name, "parameter", (base_parameter(self, p.name, self.values, None),), ({p.name: float(p.default)},)
            )
            for p in OWN
        ]
        return [*terms, *wrong]

    def kernel(self, measured: Sequence[str], *, unnamed: bool = False, constant: Sequence[str] = ()) -> Kernel:
        return RailKernel()

    def start(self) -> dict[str, float]:
        return {"speed": 0.0}

    def substeps(self, step: float) -> int:
        return 4

    def replayer(self, place: Workplace) -> RailReplayer:
        return RailReplayer()

    def refined(self, claims: Mapping[str, float]) -> Rail:
        return Rail({**self.values, **claims})


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Logs of a mass with dry friction, pushed to and fro."""
    folder, time, made = tmp_path_factory.mktemp("rail"), times(8.0, STEP), []
    for seed, name in enumerate(("e1", "e2", "v1")):
        rng = np.random.default_rng(seed)
        waves = zip((0.8, 1.9, 4.2, 6.9), rng.uniform(0.0, 2.0 * np.pi, 4), strict=True)
        push = np.sum([2.0 * np.sin(w * time + a) for w, a in waves], axis=0)
        speed = integrated(lambda v, u: (u - VISCOUS * v - FORCE * np.tanh(v / SOFT)) / MASS, [0.0], push, STEP)[:, 0]
        read = speed + NOISE * rng.standard_normal(time.size)
        made.append(write_log(folder / f"{name}.csv", {"time": time, "push": push, "speed": read}))
    return made


def test_an_object_that_is_no_model_is_refined_to_its_dry_friction(logs: list[Path], tmp_path: Path) -> None:
    refined = cosim.refine(Rail(), tmp_path, logs=logs[:2], validation=logs[2:])
    (entry,) = refined.effects
    assert (refined.verdict, entry["name"]) == ("effect_found", "coulomb")
    low, high = entry["parameters"]["force"]["ci95"]
    assert low - (high - low) < FORCE < high + (high - low)
    error, floor = refined.record["error"], refined.record["noise_floor"]["speed"]
    before, after = (error[name]["validation"]["speed"] for name in ("before", "after"))
    assert after < min(0.1 * before, 3.0 * floor)
    assert (refined.record["replays"]["through"], refined.record["grade"]) == ("own", "claimed")
    # what needs a model is left out
    assert sorted(p.name for p in tmp_path.iterdir()) == ["refine.json", "report.html"]
    jsonschema.validate(json.loads((tmp_path / "refine.json").read_text()), schema_of("refine_result"))
    assert "cosim run scenario.yaml" not in (tmp_path / "report.html").read_text()


def test_faults_of_a_study_of_an_object_name_the_argument(logs: list[Path]) -> None:
    with pytest.raises(InputError) as raised:
        study_of(Rail(), [logs[0], "missing.csv"], noise={"speeed": 1.0}, candidates=["stiction"])
    assert [fault.message.partition(":")[0] for fault in raised.value.faults] == [
        "candidates.0",
        "logs.estimation.1",
        "noise.speeed",
    ]
