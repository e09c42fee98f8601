"""Extended Kalman filter on the nonlinear craft equations with filterpy, observable with absolute fixes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from controller.design_model import Matrix
from controller.observers import Estimator
from controller.settings import AXES, PLANT_STATES, SENSED, ExtendedSettings, variances_of
from cosim.model import Moment, Stepper
from plant.hovercraft import Hovercraft

ESTIMATED = ("x", "vx", "psi", "psi_dot")
SIZE, AT = len(PLANT_STATES), PLANT_STATES.index


class Slopes:
    """Jacobians ∂f/∂x (`state`), ∂f/∂u (`command`) and ∂h/∂x (`output`) of a craft at given states and commands.

    Args:
        printed: Loaded module of `cosim.model.symbolic.linearize.printed_jacobians` for the craft.
    """

    def __init__(self, craft: Hovercraft, printed: Mapping[str, Any]) -> None:
        owners = {"": craft} | {e.name: e for e in craft.effects}
        self.printed = printed
        self.numbers = []
        for name in printed["PARAMETERS"]:
            owner, _, own = name.rpartition(".")  # a missing effect has its default
            value = getattr(owners[owner], own) if owner in owners else craft.declared[name].default
            self.numbers.append(float(value))

    def along(self, name: str, states: Matrix, commands: Matrix, shape: tuple[int, int]) -> Matrix:
        """Return a Jacobian (points, *shape) at states (points, 14) and commands (points, 4)."""
        places, function = self.printed[name.upper()], self.printed[f"{name}_jacobian"]
        entries: list[Any] = [0.0] * len(places)
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # both sides of branches are computed
            function(0.0, tuple(states.T), tuple(commands.T), self.numbers, entries)
        matrices = np.zeros((len(states), *shape))
        for (row, column), entry in zip(places, entries, strict=True):
            matrices[:, row, column] = entry
        return matrices


def carried(psi: float) -> Matrix:
    """Return G (14, 14), which transfers noise from craft to world axes."""
    G = np.eye(SIZE)
    along, aside = AT("x"), AT("y")
    G[AT("x_world"), along], G[AT("x_world"), aside] = math.cos(psi), math.sin(psi)
    G[AT("y_world"), along], G[AT("y_world"), aside] = math.sin(psi), -math.cos(psi)
    return G


class ExtendedFilter(Estimator):
    """Extended Kalman filter for the plant's 14 states.

         x̂ = f(x̂, u),   P = F·P·F' + G·Q·G',   F = I + Δt·A + … + (Δt·A)⁴/24,   A = ∂f/∂x at x̂

    G = I, except for the world position, moved by the noise of x and y with (cos ψ, sin ψ), (sin ψ, −cos ψ).

    Each sample predicts with the held command, updates with (ψ, ψ̇, a_x), and updates with a position fix if a new one
    has arrived. The start is known exactly: P = 0. Positions are along the craft's own axes, fixes along `axes`.

    Args:
        jacobians: Loaded module of `cosim.model.symbolic.linearize.printed_jacobians` for this model and (a_x).
    """

    def __init__(
        self,
        model: Hovercraft,
        settings: ExtendedSettings,
        jacobians: Mapping[str, Any],
        start: Mapping[str, float],
        fix: float = 0.0,
    ) -> None:
        self.settings, self.slopes, self.stepper = settings, Slopes(model, jacobians), Stepper(model)
        self.outputs = [[q.name for q in model.outputs].index(name) for name in SENSED]
        self.filter = kf = ExtendedKalmanFilter(SIZE, len(SENSED))
        kf.x, kf.P = np.array(model.start(start), dtype=float), np.zeros((SIZE, SIZE))
        self.noise = np.diag(variances_of(settings, "process", PLANT_STATES))
        kf.R = np.diag(variances_of(settings, "measurement", SENSED))
        self.fixed = [AT(name) for name in AXES[settings.axes]]
        self.fix_noise = np.diag(variances_of(settings, "measurement", ("x", "y")))
        self.command: tuple[float, ...] = model.start_command()
        self.fix = fix
        self.damping = model.friction / model.mass  # [1/s]

    def step(
        self, measured: Sequence[float], command: Sequence[float], fix: float = 0.0, position: Sequence[float] = (0, 0)
    ) -> None:
        kf, dt, latency = self.filter, self.settings.sample_time, self.settings.fix_latency
        self.command = tuple(command)
        A = dt * self.slope("state", SIZE)
        A2 = A @ A
        G = carried(float(kf.x[AT("psi")]))
        F = np.eye(SIZE) + A + A2 / 2.0 + A2 @ A / 6.0 + A2 @ A2 / 24.0
        kf.x = np.array(self.stepper.step(Moment(0.0, tuple(kf.x.tolist())), self.command, dt).state)
        kf.P = F @ kf.P @ F.T + G @ self.noise @ G.T

        H = np.zeros((3, SIZE))
        H[0, AT("psi")] = H[1, AT("psi_dot")] = 1.0
        H[2] = self.slope("output", 1)[0]
        kf.update(np.array(measured), lambda _: H, self.sensed)
        self.nis = self.squared_innovation()
        if fix == self.fix:
            return
        self.fix = fix

        def located(x: Matrix) -> Matrix:
            """Return a fix of age T: p(t − T) = p − T·ṗ to first order."""
            rate = self.stepper.derivative(0.0, tuple(x.tolist()), self.command)
            return np.array([x[k] - latency * rate[k] for k in self.fixed])

        H_fix = (np.eye(SIZE) - latency * self.slope("state", SIZE))[self.fixed]
        kf.update(np.array(position), lambda _: H_fix, located, self.fix_noise)
        self.fix_nis = self.squared_innovation()

    def slope(self, name: str, rows: int) -> Matrix:
        """Return ∂f/∂x or ∂h/∂x at the estimate."""
        slopes: Matrix = self.slopes.along(name, self.filter.x[None], np.array([self.command]), (rows, SIZE))[0]
        return slopes

    def sensed(self, x: Matrix) -> Matrix:
        """Return (ψ, ψ̇, a_x)."""
        y = self.stepper.output(0.0, tuple(x.tolist()), self.command)
        return np.array([y[k] for k in self.outputs])

    @property
    def estimate(self) -> tuple[float, ...]:
        x = dict(zip(PLANT_STATES, self.filter.x.tolist(), strict=True))
        ax = float(self.sensed(self.filter.x)[2])
        return *(x[name] for name in ESTIMATED), ax + self.damping * x["vx"], x["y"]

    @property
    def sigma(self) -> tuple[float, ...]:
        P = self.filter.P
        return tuple(math.sqrt(max(0.0, P[k, k])) for k in map(AT, ("x", "psi", "y")))


def level_tilt(model: Hovercraft, a: float) -> float:
    """Return the common tilt [rad] for thrust acceleration a [m/s²] at hover; at most ±90°."""
    stepper = Stepper(model)
    outputs = dict(zip((q.name for q in model.outputs), stepper.output(0.0, model.start(), ()), strict=True))
    return math.asin(max(-1.0, min(1.0, a * model.mass / (outputs["thrust_right"] + outputs["thrust_left"]))))
