"""Monte Carlo tests of estimators: normalised errors and innovations over many runs with known truth.

The truth is the linear model with the disturbance V of eq 5.47, the plant with the extended filter's process noise, or
the undisturbed plant. Every case has two flights: sinusoidal tilts, and the manoeuvre of App. G. All runs share the
commands of a flight; the seed determines the noise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from controller.closed_loop import ClosedLoop
from controller.design_model import Matrix, discrete_model, measurement_matrix
from controller.observers import AT, ESTIMATED, ExtendedFilter, LinearFilter, carried
from controller.settings import ESTIMATORS, PLANT_STATES, SENSED, ExtendedSettings, Settings, variances_of
from cosim.model import Moment, Stepper
from cosim.model.namespaces import arrays
from plant.hovercraft import Hovercraft

SETTLING = 50  # samples before errors count
FIX_EVERY = 5  # samples, 10 Hz
OWN = [k for k, name in enumerate(PLANT_STATES) if not name.endswith("_world")]  # P of the world position is singular
SENSED_AT = [[q.name for q in Hovercraft.outputs].index(name) for name in SENSED]
# NEES, NIS, NIS of fixes → (runs, times), degrees of freedom, times [s]
Squares = Mapping[str, tuple[Matrix, int, Matrix]]
Truth = tuple[Matrix, Matrix, Matrix]  # states, readings and positions of every run; each (samples, runs, values)


@dataclass(frozen=True)
class Flight:
    """A motion for tests of estimators.

    Attributes:
        name: Name of the motion.
        doc: Description of the motion.
        commands: Number of samples → duties and tilts at each, shape (samples, 4).
    """

    name: str
    doc: str
    commands: Callable[[int], Matrix]


def sines(steps: int) -> Matrix:
    """Return commands with sinusoidal tilts [rad] and nominal duties."""
    t = Settings().sample_time * np.arange(steps)
    along, about = 0.08 * np.sin(0.9 * t), 0.05 * np.sin(2.3 * t)
    duty = np.full(steps, Hovercraft().duty_nominal)
    return np.stack([duty, duty, along + about, along - about], axis=1)


@cache
def flown_manoeuvre(steps: int) -> Matrix:
    """Return the commands of the LQR for the manoeuvre of App. G, simulated without noise."""
    craft = Hovercraft()
    rig = ClosedLoop(craft, craft.excursion, {}, craft.rate * steps)
    trial = rig.play(craft, rig.usual_signals(craft.rate * np.arange(steps, dtype=np.float64)))
    return np.column_stack([*trial.inputs.values()])


SINES = Flight("sines of the tilts", "tilts of ±0.08 rad together and ±0.05 rad against each other", sines)
MANOEUVRE = Flight(
    "manoeuvre of App. G",
    "by the LQR: turn right by 90° at 1 s, forward 1.5 m at 5 s, turn about at 10 s, forward at 17 s, right at 22 s",
    flown_manoeuvre,
)


@dataclass(frozen=True)
class FlightCase:
    """A case of the Monte Carlo test: an estimator, a true plant and a flight, with or without position fixes."""

    title: str
    truth: str
    estimator: str
    fixes: bool = False
    flight: Flight = SINES


ON_SINES = (
    FlightCase("consistent on its own model, disturbed with V", "linear", "consistent"),
    FlightCase("consistent on its own model, with fixes", "linear", "consistent", fixes=True),
    FlightCase("appendix_f on the model of consistent, disturbed with V", "linear", "appendix_f"),
    FlightCase("lagged on the model of consistent, disturbed with V", "linear", "lagged"),
    FlightCase("extended on the plant, disturbed with its Q", "disturbed", "extended"),
    FlightCase("extended on the disturbed plant, with fixes", "disturbed", "extended", fixes=True),
    FlightCase("appendix_f on the plant as it is", "plant", "appendix_f"),
    FlightCase("lagged on the plant as it is", "plant", "lagged"),
    FlightCase("consistent on the plant as it is", "plant", "consistent"),
    FlightCase("extended on the plant as it is", "plant", "extended"),
)
CASES = (*ON_SINES, *(replace(case, flight=MANOEUVRE) for case in ON_SINES))


def linear_truth(runs: int, u: Matrix, rng: np.random.Generator) -> Truth:
    """Return runs of the linear model `consistent` with its noise, without noise of the sensors.

    x⁺ = F·x + G·u + w, z = H·x + v, from x = 0; w by V, v by W.
    """
    p = Settings(estimator="consistent")
    (F, G), H = discrete_model(p), measurement_matrix(p, p.estimator)
    x, states = np.zeros((runs, 5)), []
    for k in range(len(u)):
        x = x @ F.T + u[k, 2:] @ G.T + rng.normal(0.0, np.sqrt(p.process_variances), (runs, 5))
        states.append(x)
    S = np.array(states)
    return S, S @ H.T, S[..., [0]]


def plant_truth(runs: int, u: Matrix, rng: np.random.Generator, *, disturbed: bool) -> Truth:
    """Return runs of the plant's equations, optionally with the extended filter's process noise.

    Readings and positions have no noise.
    """
    p, stepper = ExtendedSettings(), Stepper(Hovercraft(), arrays())
    deviation = np.sqrt(variances_of(p, "process", PLANT_STATES)) * float(disturbed)
    state = np.tile(np.array(Hovercraft().start()), (runs, 1))
    states, sensors = [], []
    for k in range(len(u)):
        G = np.array([carried(psi) for psi in state[:, AT("psi")]])
        moment = stepper.step(Moment(0.0, tuple(state.T)), tuple(u[k]), p.sample_time)
        noise = np.einsum("rij,rj->ri", G, rng.normal(0.0, 1.0, state.shape) * deviation)
        state = np.stack(np.broadcast_arrays(*moment.state), axis=1) + noise
        y = stepper.output(0.0, tuple(state.T), tuple(u[k]))
        states.append(state)
        sensors.append(np.stack([y[j] for j in SENSED_AT], axis=1))
    S = np.array(states)
    return S, np.array(sensors), S[..., [AT("x"), AT("y")]]


def squares_of(case: FlightCase, runs: int, steps: int, rng: np.random.Generator) -> Squares:
    """Return normalised errors and innovations, each (runs, times), after the first second."""
    u = case.flight.commands(steps)
    if case.truth == "linear":
        assumed: Settings | ExtendedSettings = Settings()
        states, readings, positions = linear_truth(runs, u, rng)
    else:
        assumed = ExtendedSettings()
        states, readings, positions = plant_truth(runs, u, rng, disturbed=case.truth == "disturbed")
    deviations = np.sqrt(variances_of(assumed, "measurement", SENSED))
    readings = readings + rng.normal(0.0, deviations, readings.shape)
    deviations = np.sqrt(variances_of(assumed, "measurement", ("x", "y")[: positions.shape[-1]]))
    positions = positions + rng.normal(0.0, deviations, positions.shape)
    craft = Hovercraft()
    stepper = Stepper(craft)
    nees, nis, fixed = (np.zeros((runs, steps)) for _ in range(3))
    for r in range(runs):
        estimator: LinearFilter | ExtendedFilter
        if case.estimator in ESTIMATORS:
            estimator = LinearFilter(Settings(estimator=case.estimator), (0.0,) * 5)
        else:
            estimator = ExtendedFilter(craft, ExtendedSettings(), _jacobians(), {})
        for k in range(steps):
            fix = float((k + 1) // FIX_EVERY) if case.fixes else 0.0
            estimator.step(readings[k, r], u[k], fix, positions[k, r])
            kf, state = estimator.filter, states[k, r]
            e, P = kf.x - state[: len(kf.x)], kf.P
            if isinstance(estimator, ExtendedFilter):
                e, P = e[OWN], P[np.ix_(OWN, OWN)]
            elif len(state) > len(kf.x):  # the plant's thrust acceleration (F_Rx + F_Lx)/m is a_x without friction
                ax = float(stepper.output(0.0, tuple(state.tolist()), ())[SENSED_AT[2]])
                a = ax + craft.friction / craft.mass * float(state[AT("vx")])
                e = kf.x - np.array([*(state[AT(name)] for name in ESTIMATED), a])
            nees[r, k] = e @ np.linalg.solve(P, e)
            nis[r, k], fixed[r, k] = estimator.nis, estimator.fix_nis
    settled, with_fix = slice(SETTLING, None), slice(SETTLING + FIX_EVERY - 1, None, FIX_EVERY)
    t = Settings().sample_time * np.arange(1.0, steps + 1.0)
    squares = {"NEES": (nees[:, settled], len(e), t[settled]), "NIS": (nis[:, settled], 3, t[settled])}
    if case.fixes:  # every fifth sample has a new fix
        squares["NIS of fixes"] = (fixed[:, with_fix], positions.shape[-1], t[with_fix])
    return squares


@cache
def _jacobians() -> Mapping[str, Any]:
    from cosim.model.symbolic.linearize import load_names, printed_jacobians

    return load_names(printed_jacobians(Hovercraft(), ("ax",)))
