"""State estimators of the controllers, based on filterpy: Kalman filters of the thesis, and an extended one (§5.6)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from operator import attrgetter
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, KalmanFilter

from controller.design_model import Matrix, discrete_model, discretize, fix_matrix, measurement_matrix
from controller.settings import (
    AXES,
    PLANT_STATES,
    SENSED,
    ExtendedSettings,
    FilterSettings,
    Floats,
    Numbers,
    variances_of,
)
from cosim.model import Moment, Stepper
from plant.hovercraft import Hovercraft

ESTIMATED_STATES = ("x", "vx", "psi", "psi_dot")
PLANT_SIZE, AT = len(PLANT_STATES), PLANT_STATES.index
# x_world and y_world repeat x and y without weight, so that predictive control predicts twelve of the fourteen states.
PREDICTED = [k for k, name in enumerate(PLANT_STATES) if not name.endswith("_world")]
PREDICTED_STATES = [PLANT_STATES[k] for k in PREDICTED]
FILTERED = [PREDICTED_STATES.index(name) for name in ESTIMATED_STATES]  # states of the filter of the thesis
OBSERVED = [k for k in range(len(PREDICTED_STATES)) if k not in FILTERED]


class Stateful:
    """An object whose complete state consists of named attributes: numbers, lists and arrays.

    Attributes:
        memory: Names of these attributes, including attributes of parts, such as `filter.x`.
    """

    memory: tuple[str, ...] = ()

    def snapshot(self) -> dict[str, Any]:
        """Return the complete state as plain numbers."""
        values = {name: attrgetter(name)(self) for name in self.memory}
        return {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in values.items()}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restore a snapshot exactly."""
        for name, value in snapshot.items():
            part, _, own = name.rpartition(".")
            owner = attrgetter(part)(self) if part else self
            is_array = isinstance(getattr(owner, own), np.ndarray)
            setattr(owner, own, np.array(value) if is_array else value)


class Estimator(Stateful):
    """A state estimator, by default a filter of filterpy.

    A subclass defines `advance`, `estimate`, `variances` and, if it uses position fixes, `locate`.

    Attributes:
        fix: Number of the latest position fix.
        nis, fix_nis: Normalised squared innovation of the last sample, and of the last fix.
    """

    memory: tuple[str, ...] = ("filter.x", "filter.P", "fix", "nis")
    filter: Any
    fix, nis, fix_nis = 0.0, 0.0, 0.0

    def step(self, measured: Numbers, command: Numbers, fix: float = 0.0, position: Numbers = (0, 0)) -> None:
        """Process a sample.

        Args:
            measured: (ψ, ψ̇, a_x).
            command: Duties [%] and tilts [rad] that acted until now.
            fix: Number of the latest position fix.
            position: Latest position fix (x, y) [m].
        """
        self.advance(measured, command)
        if fix != self.fix:
            self.fix = fix
            self.locate(position)

    def advance(self, measured: Numbers, command: Numbers) -> None:
        """Predict a sample and update by its readings."""
        raise NotImplementedError

    def locate(self, position: Numbers) -> None:
        """Update by a new position fix."""

    @property
    def estimate(self) -> Floats:
        """Return (x, ẋ, ψ, ψ̇, a) of the five-state model, then y, 0 where it is not estimated."""
        raise NotImplementedError

    @property
    def variances(self) -> Floats:
        """Return estimated variances of x, ψ and y."""
        raise NotImplementedError

    @property
    def sigma(self) -> Floats:
        """Return estimated standard deviations of x, ψ and y."""
        return tuple(math.sqrt(max(0.0, v)) for v in self.variances)

    def outputs(self) -> list[float]:
        """Return estimate, standard deviations and NIS."""
        return [*self.estimate, *self.sigma, self.nis]

    def update(self, readings: Numbers, *model: Any) -> float:
        """Update the filter, and return the normalised squared innovation; `model` has filterpy's further arguments."""
        kf = self.filter
        kf.update(np.array(readings), *model)
        return float(kf.y @ kf.SI @ kf.y)


def kalman_filter(p: FilterSettings, x_hat: Matrix) -> KalmanFilter:
    """Return a filter with a known initial state: P = 0, V and W of eqs 5.46 and 5.47."""
    kf = KalmanFilter(dim_x=5, dim_z=3, dim_u=2)
    kf.x = np.array(x_hat, dtype=float)
    kf.P = np.zeros((5, 5))
    kf.F, kf.B = discrete_model(p)
    kf.H = measurement_matrix(p, p.estimator)
    kf.Q = np.diag(p.process_variances)
    kf.R = np.diag(p.measurement_variances)
    return kf


class LinearFilter(Estimator):
    """Kalman filter of the thesis, eqs 5.37-5.41, as in the controller: prediction, update, new fix."""

    def __init__(self, settings: FilterSettings, start: Numbers, fix: float = 0.0) -> None:
        self.filter, self.fix = kalman_filter(settings, np.array(start)), fix
        self.fix_model = np.diag((settings.measurement_variance_x,)), fix_matrix(settings)

    def advance(self, measured: Numbers, command: Numbers) -> None:
        self.filter.predict(u=np.array(command[2:]))  # the tilts
        self.nis = self.update(measured)

    def locate(self, position: Numbers) -> None:
        self.fix_nis = self.update(position[:1], *self.fix_model)

    @property
    def estimate(self) -> Floats:
        return *self.filter.x.tolist(), 0.0

    @property
    def variances(self) -> Floats:
        return self.filter.P[0, 0], self.filter.P[2, 2], 0.0


class HoverFilter(LinearFilter):
    """Filter of the thesis, and a second filter for the deviations of y, vy, roll, thrusts and tilts from hover.

    The latter starts at rest with P = 0; commands drive it, fixes of y correct it.

    Args:
        hover: Predicted states of the hovering craft, their A (12, 12) and B (12, 4).
    """

    memory = (*LinearFilter.memory, "observer.x", "observer.P")

    def __init__(self, p: Any, hover: tuple[Matrix, Matrix, Matrix], start: Numbers, fix: float, y_hat: float) -> None:
        super().__init__(p, start, fix)
        self.hover, A, B = hover
        n = len(OBSERVED)
        self.rest = np.array([p.duty_nominal, p.duty_nominal, 0.0, 0.0])
        self.observer = kf = KalmanFilter(dim_x=n, dim_z=1, dim_u=len(self.rest))
        kf.F, kf.B = discretize(A[np.ix_(OBSERVED, OBSERVED)], B[OBSERVED], p.sample_time)
        kf.x, kf.P, kf.Q, kf.H = np.zeros(n), np.zeros((n, n)), np.zeros((n, n)), np.zeros((1, n))
        self.y, vy = (OBSERVED.index(PREDICTED_STATES.index(name)) for name in ("y", "vy"))
        kf.x[self.y] = y_hat
        kf.Q[self.y, self.y], kf.Q[vy, vy] = p.process_variance_x, p.process_variance_vx  # as along the craft's axis
        kf.H[0, self.y], kf.H[0, vy] = 1.0, -p.fix_latency
        kf.R = np.eye(1) * p.measurement_variance_x  # same sensor as for x

    def advance(self, measured: Numbers, command: Numbers) -> None:
        super().advance(measured, command)
        self.observer.predict(u=np.array(command) - self.rest)

    def locate(self, position: Numbers) -> None:
        super().locate(position)
        self.observer.update(np.array(position[1:]))

    @property
    def estimate(self) -> Floats:
        return *self.filter.x.tolist(), float(self.observer.x[self.y])

    @property
    def variances(self) -> Floats:
        return self.filter.P[0, 0], self.filter.P[2, 2], self.observer.P[self.y, self.y]

    @property
    def predicted(self) -> Matrix:
        """Return the states of a prediction."""
        x = self.hover.copy()
        x[OBSERVED] += self.observer.x
        x[FILTERED] += self.filter.x[: len(FILTERED)]
        return x


class DoubleIntegration(Estimator):
    """Integrated acceleration with measured heading and yaw rate (Figs 5.5-5.7), without fixes.

    v̂ += Δt·a_x,   x̂ += Δt·v̂ + Δt²/2·a_x,   P = F·P·F' + g·W_a·g',   g = (Δt²/2, Δt)
    """

    memory = ("values", "spread")

    def __init__(self, settings: FilterSettings, start: Numbers, fix: float = 0.0) -> None:
        self.dt, self.noise = settings.sample_time, settings.measurement_variances
        self.values = [float(v) for v in start]
        self.spread = [0.0, 0.0, 0.0]  # variances of x̂, of x̂ with v̂, and of v̂

    def advance(self, measured: Numbers, command: Numbers) -> None:
        dt, W, (x, v, *_) = self.dt, self.noise[2], self.values
        psi, psi_dot, ax = measured
        self.values = [x + dt * v + 0.5 * dt * dt * ax, v + dt * ax, psi, psi_dot, ax]
        xx, xv, vv = self.spread
        self.spread = [
            xx + dt * (2.0 * xv + dt * vv) + 0.25 * dt**4 * W,
            xv + dt * vv + 0.5 * dt**3 * W,
            vv + dt * dt * W,
        ]

    @property
    def estimate(self) -> Floats:
        return *self.values, 0.0

    @property
    def variances(self) -> Floats:
        return self.spread[0], self.noise[0], 0.0


# -- extended Kalman filter on the craft's equations, observable with absolute fixes ----------------


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

    def along(self, name: str, states: Matrix, commands: Matrix) -> Matrix:
        """Return a Jacobian at states (points, 14) and commands (points, 4), shape (points, rows, columns)."""
        places, function = self.printed[name.upper()], self.printed[f"{name}_jacobian"]
        entries: list[Any] = [0.0] * len(places)
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # both sides of branches are computed
            function(0.0, tuple(states.T), tuple(commands.T), self.numbers, entries)
        rows, columns = 1 if name == "output" else PLANT_SIZE, (commands if name == "command" else states).shape[1]
        matrices = np.zeros((len(states), rows, columns))
        for (row, column), entry in zip(places, entries, strict=True):
            matrices[:, row, column] = entry
        return matrices


def carried(psi: float) -> Matrix:
    """Return G (14, 14), by which noise along the craft's axes also moves the world position."""
    G, s, c = np.eye(PLANT_SIZE), math.sin(psi), math.cos(psi)
    G[np.ix_([AT("x_world"), AT("y_world")], [AT("x"), AT("y")])] = (c, s), (s, -c)
    return G


class ExtendedFilter(Estimator):
    """Extended Kalman filter for the plant's 14 states.

         x̂ = f(x̂, u),   P = F·P·F' + G·Q·G',   F = I + Δt·A + … + (Δt·A)⁴/24,   A = ∂f/∂x at x̂

    G = I, except for the world position, moved by the noise of x and y with (cos ψ, sin ψ), (sin ψ, −cos ψ).

    Each sample predicts with the held command, updates with (ψ, ψ̇, a_x), and updates with a position fix if a new one
    has arrived. The initial state is known exactly: P = 0. Positions are along the craft's own axes, fixes along
    `axes`.

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
        self.sensors = [[q.name for q in model.outputs].index(name) for name in SENSED]
        self.filter = kf = ExtendedKalmanFilter(PLANT_SIZE, len(SENSED))
        kf.x, kf.P = np.array(model.start(start), dtype=float), np.zeros((PLANT_SIZE, PLANT_SIZE))
        self.noise = np.diag(variances_of(settings, "process", PLANT_STATES))
        kf.R = np.diag(variances_of(settings, "measurement", SENSED))
        self.fixed = [AT(name) for name in AXES[settings.axes]]
        self.fix_noise = np.diag(variances_of(settings, "measurement", ("x", "y")))
        self.command, self.fix = model.start_command(), fix
        self.damping = model.friction / model.mass  # [1/s]

    def advance(self, measured: Numbers, command: Numbers) -> None:
        kf, dt, self.command = self.filter, self.settings.sample_time, tuple(command)
        A = dt * self.slope("state")
        A2, G = A @ A, carried(float(kf.x[AT("psi")]))
        F = np.eye(PLANT_SIZE) + A + A2 / 2.0 + A2 @ A / 6.0 + A2 @ A2 / 24.0
        kf.x = np.array(self.stepper.step(Moment(0.0, tuple(kf.x.tolist())), self.command, dt).state)
        kf.P = F @ kf.P @ F.T + G @ self.noise @ G.T

        H = np.zeros((3, PLANT_SIZE))
        H[0, AT("psi")] = H[1, AT("psi_dot")] = 1.0
        H[2] = self.slope("output")[0]
        self.nis = self.update(measured, lambda _: H, self.sensed)

    def locate(self, position: Numbers) -> None:
        latency = self.settings.fix_latency

        def located(x: Matrix) -> Matrix:
            """Return a fix of age T: p(t − T) = p − T·ṗ to first order."""
            rate = self.stepper.derivative(0.0, tuple(x.tolist()), self.command)
            return np.array([x[k] - latency * rate[k] for k in self.fixed])

        H = (np.eye(PLANT_SIZE) - latency * self.slope("state"))[self.fixed]
        self.fix_nis = self.update(position, lambda _: H, located, self.fix_noise)

    def slope(self, name: str) -> Matrix:
        """Return the Jacobian ∂f/∂x or ∂h/∂x at the estimate."""
        return np.asarray(self.slopes.along(name, self.filter.x[None], np.array([self.command]))[0])

    @property
    def predicted(self) -> Matrix:
        """Return the states of a prediction."""
        return np.asarray(self.filter.x[PREDICTED])

    def sensed(self, x: Matrix) -> Matrix:
        """Return (ψ, ψ̇, a_x)."""
        y = self.stepper.output(0.0, tuple(x.tolist()), self.command)
        return np.array([y[k] for k in self.sensors])

    @property
    def estimate(self) -> Floats:
        x = dict(zip(PLANT_STATES, self.filter.x.tolist(), strict=True))
        ax = float(self.sensed(self.filter.x)[2])
        return *(x[name] for name in ESTIMATED_STATES), ax + self.damping * x["vx"], x["y"]

    @property
    def variances(self) -> Floats:
        return tuple(self.filter.P[k, k] for k in map(AT, ("x", "psi", "y")))


def level_tilt(model: Hovercraft, a: float) -> float:
    """Return the common tilt [rad] for thrust acceleration a [m/s²] at hover; at most ±90°."""
    stepper = Stepper(model)
    outputs = dict(zip((q.name for q in model.outputs), stepper.output(0.0, model.start(), ()), strict=True))
    return math.asin(max(-1.0, min(1.0, a * model.mass / (outputs["thrust_right"] + outputs["thrust_left"]))))
