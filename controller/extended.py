"""Extended Kalman filter on the nonlinear craft equations with filterpy, observable with absolute fixes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from controller.design_model import Matrix
from controller.gains import Settings, declared, variance
from controller.observers import SampledFilter
from controller.slopes import Slopes
from cosim.model import Moment, Stepper, parameters_of
from cosim.model.model import Parametric
from plant.hovercraft import Hovercraft

SENSED = ("psi", "psi_dot", "ax")
AXES = {"own": ("x", "y"), "world": ("x_world", "y_world")}
STATES = tuple(q.name for q in Hovercraft.base_states)
ESTIMATED = ("x", "vx", "psi", "psi_dot")
LINEAR = {p.name: p for p in parameters_of(Settings)}


@dataclass(frozen=True, kw_only=True)
class ExtendedSettings(Parametric):
    """Assumed noise of the extended filter, and the axes of its fixes; `axes` is one of `AXES`.

    Process noise is per sample; noise of the five design states is from eq 5.47, the rest is chosen here. Motion along
    the craft's axes also moves the world position, which has no noise of its own.
    """

    process_variance_x: float = declared(LINEAR, "process_variance_x")
    process_variance_y: float = variance(1e-4, "m2", "process noise of y per step, as of x")
    process_variance_psi: float = declared(LINEAR, "process_variance_psi")
    process_variance_vx: float = declared(LINEAR, "process_variance_vx")
    process_variance_vy: float = variance(1e-4, "m2/s2", "process noise of vy per step, as of vx")
    process_variance_psi_dot: float = declared(LINEAR, "process_variance_psi_dot")
    process_variance_phi: float = variance(1e-8, "rad2", "process noise of phi per step")
    process_variance_phi_dot: float = variance(1e-6, "rad2/s2", "process noise of phi_dot per step")
    process_variance_thrust_right: float = variance(1e-6, "N2", "process noise of the right thrust per step")
    process_variance_thrust_left: float = variance(1e-6, "N2", "process noise of the left thrust per step")
    process_variance_tilt_right: float = variance(4e-6, "rad2", "process noise of the right tilt per step, a's 1e-4")
    process_variance_tilt_left: float = variance(4e-6, "rad2", "process noise of the left tilt per step, a's 1e-4")
    measurement_variance_psi: float = declared(LINEAR, "measurement_variance_psi")
    measurement_variance_psi_dot: float = declared(LINEAR, "measurement_variance_psi_dot")
    measurement_variance_ax: float = declared(LINEAR, "measurement_variance_ax")
    measurement_variance_x: float = variance(1e-4, "m2", "noise of a fix of x, §7.1")
    measurement_variance_y: float = variance(1e-4, "m2", "noise of a fix of y, §7.1; 1e6 where y is not measured")
    fix_latency: float = declared(LINEAR, "fix_latency")
    sample_time: float = declared(LINEAR, "sample_time")

    axes: str = "own"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.axes not in AXES:
            raise ValueError(f"axes is {self.axes!r}; it is one of {', '.join(AXES)}")

    @property
    def process_variances(self) -> tuple[float, ...]:
        """Return the process noise diagonal in the order of the plant's states."""
        return tuple(getattr(self, f"process_variance_{name}", 0.0) for name in STATES)

    @property
    def measurement_variances(self) -> tuple[float, ...]:
        """Return the diagonal of W, eq 5.46."""
        return tuple(getattr(self, f"measurement_variance_{name}") for name in SENSED)

    @property
    def fix_variances(self) -> tuple[float, ...]:
        """Return the noise variances of a position fix in x and y."""
        return self.measurement_variance_x, self.measurement_variance_y


HEADING = STATES.index("psi")


def carried(psi: float) -> Matrix:
    """Return G (14, 14), which transfers noise from craft to world axes."""
    G = np.eye(len(STATES))
    for row, (along, right) in (
        ("x_world", (math.cos(psi), math.sin(psi))),
        ("y_world", (math.sin(psi), -math.cos(psi))),
    ):
        G[STATES.index(row), STATES.index("x")], G[STATES.index(row), STATES.index("y")] = along, right
    return G


class FilterEquations(ExtendedKalmanFilter):  # type: ignore[misc]  # filterpy is untyped
    """Craft equations for filterpy's extended Kalman filter.

         x̂ = f(x̂, u),   P = F·P·F' + G·Q·G',   F = I + Δt·A + … + (Δt·A)⁴/24,   A = ∂f/∂x at x̂

    G = I, except for the world position, moved by the noise of x and y with (cos ψ, sin ψ), (sin ψ, −cos ψ).

    Args:
        jacobians: Loaded module of `cosim.model.symbolic.jacobian.printed_jacobians` for this model and (a_x).
    """

    def __init__(self, model: Hovercraft, settings: ExtendedSettings, jacobians: Mapping[str, Any]) -> None:
        super().__init__(len(STATES), len(SENSED))
        self.x: Matrix = np.zeros(len(STATES))
        self.settings, self.slopes = settings, Slopes(model, jacobians)
        self.stepper = Stepper(model)
        self.outputs = [[q.name for q in model.outputs].index(name) for name in SENSED]
        self.P = np.zeros((len(STATES), len(STATES)))
        self.noise, self.R = np.diag(settings.process_variances), np.diag(settings.measurement_variances)
        self.fixed = [STATES.index(name) for name in AXES[settings.axes]]
        self.fix_noise = np.diag(settings.fix_variances)
        self.command: tuple[float, ...] = model.start_command()

    def predict_x(self, u: Any = 0) -> None:
        """Predict state, transition matrix and noise of the next sample with held command."""
        dt = self.settings.sample_time
        A = dt * self.slope("state", (len(STATES), len(STATES)))
        A2 = A @ A
        G = carried(float(self.x[HEADING]))
        self.Q = G @ self.noise @ G.T
        self.F = np.eye(len(STATES)) + A + A2 / 2.0 + A2 @ A / 6.0 + A2 @ A2 / 24.0
        self.x = np.array(self.stepper.step(Moment(0.0, tuple(self.x.tolist())), self.command, dt).state)

    def slope(self, name: str, shape: tuple[int, int]) -> Matrix:
        """Return ∂f/∂x or ∂h/∂x at the estimate."""
        return self.slopes.at(name, self.x, self.command, shape)

    def sensed(self, x: Matrix) -> Matrix:
        """Return (ψ, ψ̇, a_x)."""
        y = self.stepper.output(0.0, tuple(x.tolist()), self.command)
        return np.array([y[k] for k in self.outputs])

    def sensed_slope(self, x: Matrix) -> Matrix:
        """Return the measurement matrix H = ∂(ψ, ψ̇, a_x)/∂state at the state x."""
        H = np.zeros((3, len(STATES)))
        H[0, STATES.index("psi")] = H[1, STATES.index("psi_dot")] = 1.0
        H[2] = self.slope("output", (1, len(STATES)))[0]
        return H

    def located(self, x: Matrix) -> Matrix:
        """Return a fix of age T: p(t − T) = p − T·ṗ to first order."""
        rate = self.stepper.derivative(0.0, tuple(x.tolist()), self.command)
        return np.array([x[k] - self.settings.fix_latency * rate[k] for k in self.fixed])

    def located_slope(self, x: Matrix) -> Matrix:
        """Return H of a fix."""
        size = len(STATES)
        H = np.eye(size) - self.settings.fix_latency * self.slope("state", (size, size))
        return np.asarray(H[self.fixed])


class ExtendedFilter(SampledFilter):
    """Extended Kalman filter for the plant's 14 states.

    Each sample predicts with the held command, updates with (ψ, ψ̇, a_x), and updates with a position fix if a new one
    has arrived. The start is known exactly: P = 0. Positions are along the craft's own axes, fixes along `axes`.
    """

    def __init__(
        self,
        model: Hovercraft,
        settings: ExtendedSettings,
        jacobians: Mapping[str, Any],
        start: Mapping[str, float],
        fix: float = 0.0,
    ) -> None:
        self.filter = FilterEquations(model, settings, jacobians)
        self.filter.x = np.array(model.start(start), dtype=float)
        self.fix = fix
        self.damping = model.friction / model.mass  # [1/s]

    def step(
        self, measured: Sequence[float], command: Sequence[float], fix: float = 0.0, position: Sequence[float] = (0, 0)
    ) -> None:
        """Process one sample.

        Args:
            measured: (ψ, ψ̇, a_x).
            command: Duties and tilts that acted until now.
            fix: Number of the latest fix.
            position: Latest fix.
        """
        kf = self.filter
        kf.command = tuple(command)
        kf.predict()
        kf.update(np.array(measured), kf.sensed_slope, kf.sensed)
        self.nis = self.squared_innovation()
        if fix != self.fix:
            self.fix = fix
            kf.update(np.array(position), kf.located_slope, kf.located, kf.fix_noise)
            self.fix_nis = self.squared_innovation()

    @property
    def estimate(self) -> tuple[float, ...]:
        """Return (x, ẋ, ψ, ψ̇, a) of the five-state model, then y."""
        x = dict(zip(STATES, self.filter.x.tolist(), strict=True))
        ax = float(self.filter.sensed(self.filter.x)[2])
        return *(x[name] for name in ESTIMATED), ax + self.damping * x["vx"], x["y"]

    @property
    def sigma(self) -> tuple[float, ...]:
        """Return estimated standard deviations of x, ψ and y."""
        P = self.filter.P
        return tuple(math.sqrt(max(0.0, P[k, k])) for k in map(STATES.index, ("x", "psi", "y")))


def level_tilt(model: Hovercraft, a: float) -> float:
    """Return the common tilt [rad] for thrust acceleration a [m/s²] at hover; at most ±90°."""
    stepper = Stepper(model)
    outputs = dict(zip((q.name for q in model.outputs), stepper.output(0.0, model.start(), ()), strict=True))
    return math.asin(max(-1.0, min(1.0, a * model.mass / (outputs["thrust_right"] + outputs["thrust_left"]))))
