"""A refinable object that never was a `Model`: a mass on rails, written by hand in Python, with its own filter.

x' = v        m·v' = g·u − c·v − F·tanh(v/ε) + m·d        d' = −d/T + w
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
from cosim.estimation.kernel.kernel import DISTURBANCE, MEMORY, Data, Filtered, Kernel, Layout, Simulated
from cosim.estimation.subject.candidates import Candidate, base_parameter, effect
from cosim.estimation.subject.interface import Replayer, Start, Subject, Workplace
from cosim.logs.log import Log
from cosim.model import Quantity, parameter
from cosim.model.quantities import Parameter
from cosim.refinement.study import study_of
from cosim.residuals.windows import Replay
from cosim.verbs.checks import schema_of
from tests.logs import write_log

STEP, MASS, VISCOUS, FORCE, SOFT, NOISE = 0.05, 2.0, 0.8, 0.9, 0.05, 1e-3


def coefficients(p: Mapping[str, float]) -> tuple[float, float, float]:
    """Push, drag and dry friction per mass."""
    drag = p["viscous"] + p["drag.coefficient"]
    return (1.0 + p["gain.excess"]) / p["mass"], drag / p["mass"], p["coulomb.force"] / p["mass"]


def propagate(
    by: tuple[float, float, float], fades: float, state: Sequence[float], u: float, h: float, substeps: int
) -> tuple[float, float, float]:
    """A row further by Runge and Kutta's method of fourth order; the unknown input fades by a factor a substep."""
    (push, drag, dry), (x, v, d), tanh = by, state, math.tanh
    acting = push * u
    for _ in range(substeps):
        a1 = acting + d - drag * v - dry * tanh(v / SOFT)
        w = v + 0.5 * h * a1
        a2 = acting + d - drag * w - dry * tanh(w / SOFT)
        w = v + 0.5 * h * a2
        a3 = acting + d - drag * w - dry * tanh(w / SOFT)
        w = v + h * a3
        a4 = acting + d - drag * w - dry * tanh(w / SOFT)
        x += h * (v + h * (a1 + a2 + a3) / 6.0)
        v += h * (a1 + 2.0 * (a2 + a3) + a4) / 6.0
        d *= fades
    return x, v, d


def jacobian(by: tuple[float, float, float], v: float, memory: float, h: float) -> tuple[float, ...]:
    """Entries 01, 02, 11, 12 and 22 of Φ = exp(A·h) to third order, A = [[0, 1, 0], [0, s, 1], [0, 0, −1/T]]."""
    s, f = -h * (by[1] + by[2] * (1.0 - math.tanh(v / SOFT) ** 2) / SOFT), -h / memory
    return (
        h * (1.0 + s / 2.0 + s * s / 6.0),
        h * h * (0.5 + (s + f) / 6.0),
        1.0 + s + s * s / 2.0 + s**3 / 6.0,
        h * (1.0 + (s + f) / 2.0 + (s * s + s * f + f * f) / 6.0),
        1.0 + f + f * f / 2.0 + f**3 / 6.0,
    )


class RailKernel:
    """An extended Kalman filter of position, velocity and unknown input, in plain numbers."""

    layout = Layout(
        ("mass", "viscous", "coulomb.force", "drag.coefficient", "gain.excess", MEMORY),
        ("position", "velocity", f"{DISTURBANCE}velocity"),
        ("push",),
        ("position",),
        stochastic=(0, 1, 2),
        noisy=(2,),
        rates={"position": "velocity"},
    )

    def run(self, data: Data, p: Array, x0: Array, P0: Array, q: Array, r: Array, *, states: bool = False) -> Filtered:
        rows, by, memory, h, fades = self._taken(data, p)
        errors, variances, filtered = np.full((rows, 1), np.nan), np.full((rows, 1), np.nan), np.full((rows, 3), np.nan)
        first = P0[np.triu_indices(3)].tolist()
        x, (xx, xv, xd, vv, vd, dd) = tuple(x0.tolist()), first
        qx, qv, qd = (q * data.step).tolist()
        commands, read = data.u[:, 0].tolist(), data.y[:, 0].tolist()
        noise = np.broadcast_to(r, (rows, 1))[:, 0].tolist()
        for k in range(rows):
            if k:
                a, b, c, e, f = jacobian(by, x[1], memory, data.step)
                x = propagate(by, fades, x, commands[k - 1], h, data.substeps)
                if k <= data.settle:
                    xx, xv, xd, vv, vd, dd = first
                else:  # P = Φ P Φ' + Q
                    mv, md = xv + a * vv + b * vd, xd + a * vd + b * dd
                    mx, nv, nd = xx + a * xv + b * xd, c * vv + e * vd, c * vd + e * dd
                    xx, xv, xd = mx + a * mv + b * md + qx, c * mv + e * md, f * md
                    vv, vd, dd = c * nv + e * nd + qv, f * nd, f * f * dd + qd
            if not all(map(math.isfinite, x)):
                errors[k:], variances[k:] = np.inf, 1.0
                break
            if math.isfinite(read[k]):
                innovation, s = read[k] - x[0], xx + noise[k]
                errors[k], variances[k] = innovation, s
                gx, gv, gd = xx / s, xv / s, xd / s
                x = x[0] + gx * innovation, x[1] + gv * innovation, x[2] + gd * innovation
                vv, vd, dd = vv - gv * xv, vd - gv * xd, dd - gd * xd
                xx, xv, xd = xx - gx * xx, xv - gx * xv, xd - gx * xd
            filtered[k] = x
        return Filtered(errors, variances, filtered if states else filtered[:0], np.zeros((rows if states else 0, 0)))

    def simulate(
        self, data: Data, p: Array, x0: Array, memory: Array, kicks: Array | None = None, *, first: int = 0
    ) -> Simulated:
        rows, by, _, h, fades = self._taken(data, p)
        states, x = np.full((rows, 3), np.nan), x0.tolist()
        for k in range(first, rows):
            if k > first:
                x = propagate(by, fades, x, float(data.u[k - 1, 0]), h, data.substeps)
                x = x if kicks is None else [a + b for a, b in zip(x, kicks[k].tolist(), strict=True)]
            if not all(map(math.isfinite, x)):
                break
            states[k] = x
        return Simulated(states[:, :1].copy(), states, np.zeros((rows, 0)))

    def _taken(self, data: Data, p: Array) -> tuple[int, tuple[float, float, float], float, float, float]:
        """Rows, coefficients, memory of the unknown input, substep, and by what that input fades in one."""
        numbers = dict(zip(self.layout.parameters, p.tolist(), strict=True))
        h, memory = data.step / data.substeps, numbers[MEMORY]
        return len(data.u), coefficients(numbers), memory, h, math.exp(-h / memory)


class RailReplayer(Replayer):
    """Runs of the mass itself from the states that a filter knew."""

    through = "own"

    def replays(
        self, log: Log, data: Data, values: Mapping[str, float], starts: Mapping[float, Mapping[int, Start]]
    ) -> Generator[Replay, None, None]:
        by = coefficients(values)
        for horizon, begins in starts.items():
            position = np.full(log.rows, np.nan)
            for k, start in begins.items():
                state = start.states["position"], start.states["velocity"], 0.0
                last = log.rows - 1 if math.isinf(horizon) else min(log.rows - 1, k + round(horizon / log.step))
                for row in range(k + 1, last + 1):
                    state = propagate(by, 1.0, state, float(log.inputs["push"][row - 1]), log.step / 4, 4)
                    position[row] = state[0]
            given = {k: dict(start.states) for k, start in begins.items()}
            yield Replay(horizon, given, {"position": position})


def number(name: str, default: float, unit: str, doc: str, **more: float | tuple[float, float]) -> Parameter:
    return replace(parameter(default, unit=unit, doc=doc, **more).metadata["parameter"], name=name)


OWN = (
    number("mass", MASS, "kg", "of all that moves", bounds=(0.1, 10.0), tolerance=0.05),
    number("viscous", VISCOUS, "N.s/m", "friction of the bearings", bounds=(0.0, 5.0), tolerance=0.1),
)
TERMS = {
    "coulomb": number("force", 0.0, "N", "dry friction", bounds=(0.0, 5.0), neutral=0.0, typical=0.3),
    "drag": number("coefficient", 0.0, "N.s/m", "further drag", bounds=(0.0, 5.0), neutral=0.0, typical=0.5),
    "gain": number("excess", 0.0, "1", "of the push", bounds=(-0.9, 5.0), neutral=0.0, typical=0.2),
}


class Rail(Subject):
    """The mass on rails as something that can be refined."""

    title = "Mass on rails"
    inputs = (Quantity("push", "N", "force on it"),)
    states = (Quantity("position", "m", "along the rails"), Quantity("velocity", "m/s", "along the rails"))
    outputs = states[:1]
    horizon, rate = 2.0, STEP
    parameters = OWN
    candidate_parameters = {f"{name}.{p.name}": p for name, p in TERMS.items()}  # noqa: RUF012
    sensor_variance = {"position": NOISE**2}  # noqa: RUF012
    start_variance = {"velocity": 1.0}  # noqa: RUF012

    def __init__(self, claims: Mapping[str, float] | None = None) -> None:
        self.values = {**{n: float(p.default) for n, p in self.declared.items()}, **(claims or {})}
        self.present = frozenset(n for n in TERMS if any(self.values[k] for k in self.values if k.startswith(f"{n}.")))

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
        return {"position": 0.0, "velocity": 0.0}

    def substeps(self, step: float) -> int:
        return 4

    def replayer(self, place: Workplace) -> RailReplayer:
        return RailReplayer()

    def refined(self, claims: Mapping[str, float]) -> Rail:
        return Rail({**self.values, **claims})


def logged(path: Path, seed: int, seconds: float = 8.0) -> Path:
    """A run of a mass with dry friction, integrated by small Euler steps, pushed to and fro."""
    rng, fine = np.random.default_rng(seed), 200
    rows = round(seconds / STEP) + 1
    time = STEP * np.arange(rows)
    phases, rates = rng.uniform(0.0, 2.0 * np.pi, 4), 2.0 * np.pi * np.array([0.13, 0.31, 0.67, 1.1])
    push = np.sum([2.0 * np.sin(w * time + a) for w, a in zip(rates, phases, strict=True)], axis=0)
    x, v, position = 0.0, 0.0, np.zeros(rows)
    for k in range(rows - 1):
        for _ in range(fine):
            a = (push[k] - VISCOUS * v - FORCE * math.tanh(v / SOFT)) / MASS
            x, v = x + STEP / fine * v, v + STEP / fine * a
        position[k + 1] = x
    return write_log(path, {"time": time, "push": push, "position": position + NOISE * rng.standard_normal(rows)})


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("rail")
    return [logged(folder / f"{name}.csv", seed) for seed, name in enumerate(("e1", "e2", "v1"))]


@pytest.fixture(scope="module")
def refined(logs: list[Path], tmp_path_factory: pytest.TempPathFactory) -> cosim.Refined:
    return cosim.refine(Rail(), tmp_path_factory.mktemp("out"), logs=logs[:2], validation=logs[2:])


def test_an_object_that_is_no_model_is_refined_to_its_dry_friction(refined: cosim.Refined) -> None:
    (entry,) = refined.effects
    assert (refined.verdict, entry["name"]) == ("effect_found", "coulomb")
    low, high = entry["parameters"]["force"]["ci95"]
    assert low - (high - low) < FORCE < high + (high - low)
    assert (entry["parameters"]["force"]["unit"], refined.record["grade"]) == ("N", "claimed")


def test_the_error_is_proven_on_the_sealed_log_by_its_own_replayer(refined: cosim.Refined) -> None:
    error = refined.record["error"]
    assert refined.record["replays"]["through"] == "own"
    before, after = (error[name]["validation"]["position"] for name in ("before", "after"))
    assert after < 0.1 * before
    assert after < 3.0 * refined.record["noise_floor"]["position"]


def test_what_needs_a_model_is_left_out_and_the_page_says_so(refined: cosim.Refined) -> None:
    assert sorted(p.name for p in refined.folder.iterdir()) == ["refine.json", "report.html"]
    written = json.loads((refined.folder / "refine.json").read_text())
    jsonschema.validate(written, schema_of("refine_result"))
    page = (refined.folder / "report.html").read_text()
    assert "cosim run scenario.yaml" not in page


def test_faults_of_a_study_of_an_object_name_the_argument(logs: list[Path]) -> None:
    with pytest.raises(InputError) as raised:
        study_of(Rail(), [logs[0], "missing.csv"], noise={"speed": 1.0}, candidates=["stiction"])
    assert [fault.message.partition(":")[0] for fault in raised.value.faults] == [
        "candidates.0",
        "logs.estimation.1",
        "noise.speed",
    ]
