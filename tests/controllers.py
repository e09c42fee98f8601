"""Five controllers against each other: `python -m tests.controllers [SEEDS]` prints the tables of docs/controllers.md.

Plain functions, the same loop and laws that the FMUs carry: Fig 6.2 on the true state, the manoeuvre of App. G and the
regulator under each effect and each sensor error of the catalogue at its `typical` size, with and without fixes.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.closed_loop import manoeuvre
from controller.designer import DesignFile, controller_starts
from controller.loop import IntegralFeedback, Law, LawInput, Loop, StateFeedback
from controller.predictive import PredictiveLaw
from controller.settings import (
    ESTIMATORS,
    INTEGRAL_SETTINGS,
    PLACED_SETTINGS,
    PredictiveSettings,
    Settings,
    TimeVariantSettings,
)
from controller.synthesis import LoopMode, flown_modes
from cosim.model import SCALAR, Stepper, parameters_of
from cosim.model.symbolic.linearize import load_names
from fmus.recipes import HEAVY, jacobians
from plant.hovercraft import SENSOR_VARIANCE, Hovercraft

STEP = 0.02  # [s], Fig 4.8


@cache
def printed() -> Mapping[str, Any]:
    """Return the Jacobians in an FMU."""
    return load_names(jacobians())


def predictive(p: PredictiveSettings) -> PredictiveLaw:
    """Return the predictive law."""
    return PredictiveLaw(p, printed())


Design = tuple[Settings, Callable[[Any], Law]]
LAWS: dict[str, Design] = {
    "LQR": (Settings(), StateFeedback),
    "poles": (PLACED_SETTINGS, StateFeedback),
    "LQI": (INTEGRAL_SETTINGS, IntegralFeedback),
    "MPC": (PredictiveSettings(), predictive),
    "LTV": (TimeVariantSettings(), predictive),
}
GAINS = ("LQR", "poles", "LQI")  # laws of fixed gains
QUICK = (*GAINS, "MPC")  # those that fly under every effect
OUTPUTS = [q.name for q in Hovercraft.outputs]
MEASURED = ("psi", "psi_dot", "ax")
NOISE = np.sqrt([SENSOR_VARIANCE[name] for name in MEASURED])
FIX_EVERY, FIX_NOISE = 5, 0.01  # samples, [m]: 10 Hz, of the variance the filter is told
LEGS = ((5.0, "psi"), (10.0, "x"), (17.0, "psi"), (22.0, "x"), (26.0, "psi"))  # App. G: when each command ends
WITHIN = {"x": 0.15, "psi": math.radians(15)}  # 10 % of 1.5 m, 15°
Array = NDArray[np.float64]
References = Callable[[float], tuple[float, float]]


@dataclass(frozen=True)
class Flight:
    """What was flown: times, true outputs, references, x̂, commands (δ_R, δ_L, α_R, α_L), seconds of each sample."""

    time: Array
    y: Mapping[str, Array]
    wanted: Mapping[str, Array]
    estimate: Array
    command: Array
    spent: Array
    settings: Settings

    def settled(self, name: str, band: float, rows: slice = slice(None)) -> float:
        """Return the last time outside the band [s]."""
        outside = np.abs(self.y[name] - self.wanted[name])[rows] > band
        return float(self.time[rows][outside].max(initial=0.0))

    @property
    def tilts(self) -> Array:
        """|α_R|, |α_L| [rad]."""
        return np.abs(self.command[:, 2:])


def regulate(t: float) -> tuple[float, float]:
    """References of Fig 6.2: the origin."""
    return 0.0, 0.0


def fly(
    law_of: str | Design,
    references: References = regulate,
    duration: float = 10.0,
    *,
    start: Mapping[str, float] | None = None,
    craft: Hovercraft | None = None,
    sensor: Any = None,
    seed: int | None = None,
    fixes: bool = False,
    truth: bool = False,
) -> Flight:
    """Simulate a flight: seed None for no noise, fixes of x and y at 10 Hz, truth for a law with the true state."""
    settings, make = LAWS[law_of] if isinstance(law_of, str) else law_of
    stepper, law = Stepper(craft or Hovercraft()), make(settings)
    begin = start or {}
    moment = stepper.start(0.0, begin)
    x_hat = [begin.get(n, 0.0) for n in ("x", "vx", "psi", "psi_dot")] + [0.0]
    if isinstance(law, PredictiveLaw) and law.cost is not None and "y" in begin and not fixes:
        law.y_hat = begin["y"]
    loop = Loop(settings, x_hat, *references(0.0), law=law)
    spent: list[float] = []
    rng = None if seed is None else np.random.default_rng(seed)
    rows: list[tuple[float, ...]] = []
    fix, at = 0, (0.0, 0.0)
    for k in range(round(duration / STEP)):
        command = (*law.duties, *loop.command)
        outputs = stepper.output(moment.t, moment.state, command)
        rows.append((k * STEP, *references(k * STEP), *loop.estimate, *command, *outputs))
        moment = stepper.step(moment, command, STEP)
        there = dict(zip(OUTPUTS, stepper.output(moment.t, moment.state, command), strict=True))
        noise = np.zeros(5) if rng is None else rng.normal(size=5)
        read = there if sensor is None else there | sensor.readings(SCALAR, moment.t, there)
        measured = [float(read[name] + s * e) for name, s, e in zip(MEASURED, NOISE, noise, strict=False)]
        if fixes and (k + 1) % FIX_EVERY == 0:
            fix, at = fix + 1, (float(there["x"] + FIX_NOISE * noise[3]), float(there["y"] + FIX_NOISE * noise[4]))
        x_ref, psi_ref = references((k + 1) * STEP)
        began = time.perf_counter()
        if truth:
            seen = LawInput(x_ref, psi_ref, psi=there["psi"], x_meas=at[0], y_meas=at[1], fix=fix, started=True)
            push = there["ax"] + settings.friction / settings.mass * there["vx"]
            x_hat = [*(there[n] for n in ("x", "vx", "psi", "psi_dot")), push]
            if isinstance(law, PredictiveLaw):
                law.filter.step(measured, command, fix, at)
                law.filter.filter.x = np.array(moment.state if law.cost is None else x_hat)
            loop.command = law.command(x_hat, seen)
        else:
            loop.step(measured, x_ref, psi_ref, *at, fix)
        spent.append(time.perf_counter() - began)
    table = np.array(rows).T
    y, wanted = dict(zip(OUTPUTS, table[12:], strict=True)), {"x": table[1], "psi": table[2]}
    return Flight(table[0], y, wanted, table[3:8].T, table[8:12].T, np.array(spent), settings)


def typical(kind: Any) -> dict[str, float]:
    """Return the parameters of an effect at their typical size, off neutral; shape parameters keep their defaults."""
    return {p.name: (p.neutral or 0.0) + p.typical for p in parameters_of(kind) if p.typical is not None}


def conditions() -> dict[str, dict[str, Any]]:
    """Nothing, each effect and each sensor error at its typical size, by name."""
    found: dict[str, dict[str, Any]] = {"none": {}}
    for kind in Hovercraft.catalogue:
        found[kind.name] = {
            "craft": Hovercraft().with_values({f"{kind.name}.{n}": v for n, v in typical(kind).items()})
        }
    for kind in Hovercraft.sensors:
        if not kind.late and set(kind.affected()) <= {"psi", "psi_dot", "ax"}:  # the camera is no sensor of theirs
            found[kind.name] = {"sensor": kind(**typical(kind))}
    return found


OFF = {"x": 1.0, "psi": 1.0}  # Fig 6.2


def figure_6_2() -> dict[str, tuple[float, float, float]]:
    """Settling of x and ψ within 0.02 [s] and the largest tilt [deg], on the true state, without noise."""
    flights = {name: fly(name, start=OFF, truth=True) for name in LAWS}
    return {
        name: (f.settled("x", 0.02), f.settled("psi", 0.02), math.degrees(f.tilts.max())) for name, f in flights.items()
    }


def designed(name: str, craft: Hovercraft) -> Design:
    """Return a law designed for a craft, as by `cosim build --design`."""
    settings, make = LAWS[name]
    suffix = {"LQR": "", "poles": "-pole", "LQI": "-lqi", "MPC": "-mpc", "LTV": "-ltv-mpc"}[name]
    values, *_ = controller_starts(f"controller{suffix}.fmu", DesignFile(), craft)  # type: ignore[arg-type]
    return replace(settings, **values), make


def app_g(law_of: str | Design, seeds: Iterable[int], **condition: Any) -> dict[str, float]:
    """Return the errors of the manoeuvre with noise: worst x [m] and ψ [deg], overshoot, effort, saturation."""
    flights = [fly(law_of, manoeuvre, 26.0, seed=seed, **condition) for seed in seeds]
    worst = {"x": 0.0, "psi": 0.0}
    for f in flights:
        for end, what in LEGS:
            row = round(end / STEP) - 1
            worst[what] = max(worst[what], abs(f.y[what][row] - f.wanted[what][row]))
    leg = slice(round(5 / STEP), round(10 / STEP))
    return {
        "x": worst["x"],
        "psi": math.degrees(worst["psi"]),
        # after the step of 1.5 m, to within 10 %
        "settled": float(np.mean([f.settled("x", WITHIN["x"], leg) + STEP - 5.0 for f in flights])),
        "overshoot": float(np.mean([100 * max(0.0, f.y["x"][leg].max() - 1.5) / 1.5 for f in flights])),
        "effort": float(np.mean([f.tilts.sum() * STEP for f in flights])),  # ∫ |α_R| + |α_L| dt [rad s]
        "saturated": float(np.mean([100 * (f.tilts.max(axis=1) >= f.settings.tilt_max - 1e-6) for f in flights])),
    }


def robustness(name: str, condition: Mapping[str, Any], seeds: Iterable[int], *, fixes: bool) -> Array:
    """RMS of x [m] and ψ [rad] over the last 3 s of the regulator, each seed a row."""
    flights = (fly(name, start=OFF, seed=seed, fixes=fixes, **condition) for seed in seeds)
    last = -round(3.0 / STEP)
    return np.array([[math.sqrt(float(np.mean(f.y[name][last:] ** 2))) for name in ("x", "psi")] for f in flights])


def cost(rounds: int = 5) -> dict[str, Array]:
    """Return the time [s] of a sample of estimator and law, laws interleaved: median and 99 %."""
    spent: dict[str, list[float]] = {name: [] for name in LAWS}
    for k in range(rounds):
        for name in LAWS:
            spent[name] += fly(name, start=OFF, seed=k).spent.tolist()
    return {name: np.percentile(spent[name], [50, 99]) for name in LAWS}


def swings() -> dict[str, dict[str, LoopMode]]:
    """Estimator → law of fixed gains → the swing of its turn as it flies, by the designs that the FMUs carry."""
    found: dict[str, dict[str, LoopMode]] = {estimator: {} for estimator in ESTIMATORS}
    for estimator, modes in found.items():
        for name in GAINS:
            settings: Any = LAWS[name][0]
            every = flown_modes(Settings(estimator=estimator), np.array(settings.gain_matrix))
            modes[name] = next(m for m in every if m.axis == "turning" and m.pole.imag > 0)
    return found


def print_flights(seeds: Sequence[int]) -> list[str]:
    """Print the manoeuvre of each craft; return the controllers that miss App. G's 10 % or 15° on the base craft."""
    missed = []
    heavy = Hovercraft().with_values(HEAVY)
    for title, craft, fitting in (
        ("App. G", None, False),
        ("App. G on the craft of plant-heavy.fmu", heavy, False),
        ("App. G on the craft of plant-heavy.fmu, designed for it", heavy, True),
    ):
        for fixes in (False, True):
            said = f"{title}, {'with fixes at 10 Hz' if fixes else 'IMU alone'}"
            print(f"\n{said}, {len(seeds)} seeds")
            print("       worst |x| [m]  worst |ψ| [deg]  settled [s]  overshoot [%]  effort [rad s]  saturated [%]")
            for name in LAWS:
                r = app_g(designed(name, heavy) if fitting else name, seeds, fixes=fixes, craft=craft)
                print(
                    f"{name:6} {r['x']:13.3f} {r['psi']:16.2f} {r['settled']:12.2f} {r['overshoot']:14.1f}"
                    f" {r['effort']:15.2f} {r['saturated']:14.1f}",
                    flush=True,
                )
                if craft is None and (r["x"] > WITHIN["x"] or r["psi"] > 15):
                    missed.append(f"{name}, {said}")
    return missed


def print_effects(seeds: Sequence[int]) -> None:
    """Print the regulator under each effect and each sensor error."""
    for fixes in (False, True):
        said = "with fixes at 10 Hz" if fixes else "IMU alone"
        print(f"\nRMS of x [cm] and ψ [deg] over the last 3 s of the regulator, {said}", end=": ")
        print(f"mean and worst of {len(seeds)} seeds")
        print(f"{'':25}" + "".join(f"{name + ' x':>14}{'ψ':>12}" for name in QUICK))
        for effect, condition in conditions().items():
            cells = ""
            for name in QUICK:
                r = robustness(name, condition, seeds, fixes=fixes)
                x, psi = 100 * r[:, 0], np.degrees(r[:, 1])
                cells += f"{x.mean():8.1f}{x.max():6.1f}{psi.mean():6.2f}{psi.max():6.2f}"
            print(f"{effect:25}{cells}", flush=True)


def main(seeds: int) -> int:
    """Print the tables; 1 where a controller misses App. G's 10 % or 15° in a seed."""
    print("Fig 6.2 on the true state      settled x [s]   ψ [s]   largest tilt [deg]")
    for name, (x, psi, tilt) in figure_6_2().items():
        print(f"{name:30} {x:13.2f} {psi:7.2f} {tilt:20.1f}")
    print("\nSwing of the turn as it flies: pole [rad/s], damping")
    for estimator, of_laws in swings().items():
        told = [f"{name} {m.pole.real:.1f}±{m.pole.imag:.1f}j {m.damping:.2f}" for name, m in of_laws.items()]
        print(f"{estimator:12}{'   '.join(told)}")
    spent = cost()
    print("\nTime of a sample, estimator and law [ms]: median, 99 %; over that of the LQR")
    for name, (half, most) in spent.items():
        print(f"{name:6} {1e3 * half:7.3f} {1e3 * most:7.3f} {half / spent['LQR'][0]:7.1f}")
    every = range(1, seeds + 1)
    missed = print_flights(every)
    print_effects(every)
    print(f"missed App. G's 10 % or 15°: {'; '.join(missed) or 'none'}")
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 20))
