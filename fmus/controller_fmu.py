"""Controllers and estimators as FMI slaves: a communication step is one sample.

All estimators have the same inputs and outputs, so that one line of a scenario exchanges them; likewise all
controllers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, ClassVar

from pythonfmu.enums import Fmi2Status

from controller.loop import IntegralFeedback, Law, Loop, StateFeedback
from controller.observers import DoubleIntegration, ExtendedFilter, LinearFilter, level_tilt
from controller.settings import (
    DOUBLE_INTEGRATION,
    INTEGRAL_SETTINGS,
    PLACED_SETTINGS,
    ExtendedSettings,
    FilterSettings,
    Noise,
    PredictiveSettings,
    Settings,
    TimeVariantSettings,
)
from cosim.fmi.ports import Port, Value, parameter_port
from cosim.fmi.slave import STEP, Slave
from cosim.model import parameters_of
from plant.hovercraft import DUTY_NOMINAL, Hovercraft

Dependencies = Mapping[str, Sequence[str]]
FLIGHT = "Flight controller of the hovercraft: "
LOOP, DESIGN_MODEL = "loop:Loop", "design_model:discrete_model"  # documented parts
ESTIMATE_MEANINGS = {  # name → unit, meaning
    "x": ("m", "distance along the craft's own axis"),
    "vx": ("m/s", "forward velocity"),
    "psi": ("rad", "heading"),
    "psi_dot": ("rad/s", "yaw rate"),
    "a": ("m/s2", "thrust acceleration"),
}
ESTIMATE = tuple(f"{name}_hat" for name in ESTIMATE_MEANINGS)
MEASURED_PORTS = (
    Port("psi", "input", 0.0, "rad", "measured heading, positive to the left"),
    Port("psi_dot", "input", 0.0, "rad/s", "measured yaw rate"),
    Port("ax", "input", 0.0, "m/s2", "measured forward acceleration"),
)
ESTIMATES = tuple(
    Port(f"{name}_hat", "output", 0.0, unit, f"estimated {doc}") for name, (unit, doc) in ESTIMATE_MEANINGS.items()
)
FIXES = (
    Port("x_meas", "input", 0.0, "m", "fix of x, the distance along the craft's own axis", optional=True),
    Port("y_meas", "input", 0.0, "m", "fix of y, the drift to the right", optional=True),
    Port(
        "fix",
        "input",
        0.0,
        "1",
        "number of the latest fix, 0 before the first; a change triggers an update",
        optional=True,
    ),
)
SIGMA = tuple(
    Port(f"{name}_sigma", "output", 0.0, unit, f"standard deviation of {name}_hat according to the estimator")
    for name, unit in (("x", "m"), ("psi", "rad"))
)
START_PORTS = tuple(
    Port(f"{p.name}_start", "parameter", 0.0, p.unit, f"start value of {p.name}, assumed exact") for p in ESTIMATES
)
INTEGRALS = (
    Port("x_integral", "output", 0.0, "m.s", "integral of the error of the measured position"),
    Port("psi_integral", "output", 0.0, "rad.s", "integral of the error of the measured heading"),
)
LATERAL = (
    Port("y_ref", "input", 0.0, "m", "reference of the drift to the right", optional=True),
    Port("y_hat", "output", 0.0, "m", "estimated drift to the right"),
    Port("y_sigma", "output", 0.0, "m", "standard deviation of y_hat according to the filter"),
    Port("iterations", "output", 0.0, "1", "iterations of the solver at this sample"),
    Port("solved", "output", 1.0, "1", "1 if the solver found a solution, 0 at its limit of iterations"),
    Port("y_hat_start", "parameter", 0.0, "m", "start value of y_hat, assumed exact"),
)


def settings_ports(settings: Any, choice: str, doc: str) -> tuple[Port, ...]:
    """Return the parameters of settings, and the text parameter `choice`."""
    own = (parameter_port(p, getattr(settings, p.name)) for p in parameters_of(settings))
    return (*own, Port(choice, "parameter", getattr(settings, choice), "", doc), *START_PORTS)


def controller_ports(settings: Settings, *more: Port) -> tuple[Port, ...]:
    """Return all variables of a controller FMU: inputs, outputs, parameters and start values."""
    duty = settings.duty_nominal
    every = (
        *MEASURED_PORTS,
        Port("x_ref", "input", 0.0, "m", "reference of the distance along the craft's own axis"),
        Port("psi_ref", "input", 0.0, "rad", "reference of the heading"),
        *FIXES,
        Port("duty_right", "output", duty, "%", "duty command of the right motor"),
        Port("duty_left", "output", duty, "%", "duty command of the left motor"),
        Port("tilt_right", "output", 0.0, "rad", "tilt command of the right propeller, saturated"),
        Port("tilt_left", "output", 0.0, "rad", "tilt command of the left propeller, saturated"),
        *ESTIMATES,
        *SIGMA,
        *settings_ports(settings, "estimator", f"Kalman filter: {', '.join(settings.choices['estimator'])}"),
        *more,
    )
    return tuple(p for causality in ("input", "output", "parameter") for p in every if p.causality == causality)


START_NAMES = tuple(port.name for port in START_PORTS)
# Dependencies of outputs at a sample. The axes are decoupled; of the inputs, only a fix changes the covariance.
FORWARD_DEPENDENCIES, TURN_DEPENDENCIES = ("ax", "x_meas", "fix"), ("psi", "psi_dot")
TILT_DEPENDENCIES = (*TURN_DEPENDENCIES, *FORWARD_DEPENDENCIES, "x_ref", "psi_ref")
DEPENDENCIES: Dependencies = {
    **dict.fromkeys(("duty_right", "duty_left", "psi_sigma"), ()),
    **dict.fromkeys(("tilt_right", "tilt_left"), TILT_DEPENDENCIES),
    **dict.fromkeys(("x_hat", "vx_hat", "a_hat"), FORWARD_DEPENDENCIES),
    **dict.fromkeys(("psi_hat", "psi_dot_hat"), TURN_DEPENDENCIES),
    "x_sigma": ("fix",),
}
# Dependencies in initialization mode, without filter update and with P = 0.
INITIAL_DEPENDENCIES: Dependencies = {
    **dict.fromkeys(("duty_right", "duty_left"), ("duty_nominal",)),
    **{
        f"tilt_{side}": ("x_ref", "psi_ref", "tilt_max", *(f"k_{row}_{j}" for j in range(1, 6)), *START_NAMES)
        for row, side in ((1, "right"), (2, "left"))
    },
    **{name: (f"{name}_start",) for name in ESTIMATE},
    **dict.fromkeys(("x_sigma", "psi_sigma"), ()),
}


class SampledSlave(Slave):
    """A slave with sample times: a communication step is one sample; steps other than `sample_time` are rejected.

    Attributes:
        who: Noun for messages.
        about: Description of the FMU.
        parts: Documented objects in `controller`, as `module:name`.
        needs_jacobians: True if the FMU includes generated Jacobians of the craft, so that it does not need sympy.
        settings: Default values.
        depends: Dependencies of outputs at a sample, and in initialization mode.
        running: The running loop or filter, with its complete state.
    """

    who: ClassVar[str]
    about: ClassVar[str]
    parts: ClassVar[tuple[str, ...]]
    needs_jacobians: ClassVar[bool] = False
    settings: ClassVar[Noise]
    depends: ClassVar[tuple[Dependencies, Dependencies]]
    running: Any

    def start(self, settings: Any, x_hat: list[float], given: dict[str, Value]) -> Any:
        """Return the running object (loop or filter), which starts at x̂ with P = 0 and without an update."""
        raise NotImplementedError

    def process(self) -> None:
        """Process one sample."""
        raise NotImplementedError

    def initialize(self, given: dict[str, Value]) -> None:
        """Start at `*_hat_start`, with settings from the variables that have the names of their fields."""
        names = {field.name for field in fields(self.settings)}
        values = zip((port.name for port in self.ports), self.values, strict=True)
        kind: Any = type(self.settings)
        settings = kind(**{name: value for name, value in values if name in names})
        self.sample = settings.sample_time
        self.running = self.start(settings, [float(given.get(name, 0.0)) for name in START_NAMES], given)
        self.set_outputs(self.running.outputs())

    def advance(self, t: float, h: float) -> None:
        """Process one sample; raise ValueError if the step is not one sample."""
        if abs(h - self.sample) > 1e-6 * self.sample:
            raise ValueError(f"step of {h} s; the {self.who} is sampled at {self.sample} s (parameter sample_time)")
        self.process()
        self.set_outputs(self.running.outputs())

    def snapshot(self) -> Any:
        """Return the complete state of the running controller or filter, from which `restore` continues exactly."""
        return self.running.snapshot()

    def restore(self, snapshot: Any) -> None:
        """Restore a snapshot exactly."""
        self.running.restore(snapshot)


# -- controllers ----------------------------------------------------------------------------------


def all_dependencies(ports: Sequence[Port]) -> tuple[Dependencies, Dependencies]:
    """Return dependencies of each output: all inputs at a sample, references and numbers in initialization mode."""
    outputs, inputs = ([p.name for p in ports if p.causality == causality] for causality in ("output", "input"))
    known = [p.name for p in ports if p.name.endswith("_ref") or (p.causality == "parameter" and p.kind == "Real")]
    return dict.fromkeys(outputs, inputs), dict.fromkeys(outputs, known)


class HovercraftController(SampledSlave):
    """A controller with sample times: a communication step is one sample; steps other than `sample_time` are rejected.

    The hosting Python needs numpy, scipy and filterpy. The filter starts at `*_hat_start`.
    """

    who = "controller"
    about = f"{FLIGHT}Kalman filter and LQR with tilt saturation"
    parts: ClassVar[tuple[str, ...]] = (LOOP, DESIGN_MODEL)
    feedback: ClassVar[type[Law]] = StateFeedback
    settings: ClassVar[Settings] = Settings()
    ports = controller_ports(settings)
    depends = DEPENDENCIES, INITIAL_DEPENDENCIES

    def law(self, settings: Any, given: dict[str, Value]) -> Law:
        """Return the control law for the parameters and start values that the host has set."""
        return self.feedback(settings)

    def start(self, settings: Any, x_hat: list[float], given: dict[str, Value]) -> Loop:
        """Return the control loop."""
        return Loop(settings, x_hat, *self.inputs[3:], law=self.law(settings, given))

    def process(self) -> None:
        """Process one sample."""
        self.running.step(self.inputs[:3], *self.inputs[3:])

    def terminate(self) -> None:
        """Log the remarks of the control law on the run as a warning."""
        if self.phase is STEP and (words := self.running.law.words()):
            self.log(words, Fmi2Status.warning)


class HovercraftPolesController(HovercraftController):
    """Pole placement: −2, −4, −11 rad/s of the forward axis, −4, −5 rad/s of the turn.

    The common tilt drives the forward axis, the tilt difference the turn, so that the gain of each axis is unique.
    Poles of different axes may be equal.
    """

    about = f"{FLIGHT}Kalman filter and poles placed, with tilt saturation"
    settings = PLACED_SETTINGS
    ports = controller_ports(settings)


class HovercraftIntegralController(HovercraftController):
    """LQR with integral action on measured errors: of x from position fixes, of ψ from the IMU."""

    about = f"{FLIGHT}Kalman filter and LQR with integrals of position and heading"
    parts = (LOOP, DESIGN_MODEL, "loop:IntegralFeedback")
    feedback = IntegralFeedback
    settings = INTEGRAL_SETTINGS
    ports = controller_ports(settings, *INTEGRALS)
    # saturation of a tilt affects both integrals
    depends = (
        {**DEPENDENCIES, **dict.fromkeys(("x_integral", "psi_integral"), TILT_DEPENDENCIES)},
        all_dependencies(ports)[1],
    )


class HovercraftPredictiveController(HovercraftController):
    """Model predictive control with limits of tilt and duty, and with control of y by position fixes.

    The host also needs the solver daqp.
    """

    about = f"{FLIGHT}Kalman filter and model predictive control with limits"
    parts: ClassVar[tuple[str, ...]] = (LOOP, DESIGN_MODEL, "predictive:PredictiveLaw", "observers:HoverFilter")
    needs_jacobians = True
    settings: ClassVar[Settings] = PredictiveSettings()
    ports = controller_ports(settings, *LATERAL)
    depends = all_dependencies(ports)

    def law(self, settings: Any, given: dict[str, Value]) -> Law:
        """Return the predictive law; its solver is imported here, since other controllers do not need it."""
        from controller import printed  # type: ignore[attr-defined]  # printed when the FMU is built
        from controller.predictive import PredictiveLaw

        return PredictiveLaw(settings, vars(printed), float(given.get("y_hat_start", 0.0)))


class HovercraftTimeVariantController(HovercraftPredictiveController):
    """Predictive control with A(t), B(t) along the planned motion, and its own extended Kalman filter.

    Tilt and duty are limited. With position fixes, y is controlled too. The host also needs the solver daqp.
    """

    about = f"{FLIGHT}extended Kalman filter and predictive control along the planned motion"
    parts = (LOOP, "predictive:PredictiveLaw", "observers:ExtendedFilter")
    settings = TimeVariantSettings()
    ports = controller_ports(settings, *LATERAL)
    depends = all_dependencies(ports)


# -- estimators -----------------------------------------------------------------------------------

NIS = "normalised innovation squared of (psi, psi_dot, ax), 3 in the mean where it is right"
SIGNAL_PORTS = (
    *MEASURED_PORTS,
    Port("duty_right", "input", DUTY_NOMINAL, "%", "duty command of the right motor, as it has acted"),
    Port("duty_left", "input", DUTY_NOMINAL, "%", "duty command of the left motor, as it has acted"),
    Port("tilt_right", "input", 0.0, "rad", "tilt command of the right propeller, as it has acted"),
    Port("tilt_left", "input", 0.0, "rad", "tilt command of the left propeller, as it has acted"),
    *FIXES,
    *ESTIMATES,
    Port("y_hat", "output", 0.0, "m", "estimated drift to the right; 0 where it is not estimated"),
    *SIGMA,
    Port("y_sigma", "output", 0.0, "m", "standard deviation of y_hat according to the estimator"),
    Port("nis", "output", 0.0, "1", NIS),
)
OUTPUT_NAMES = tuple(p.name for p in SIGNAL_PORTS if p.causality == "output")
# Inputs are constant until the next sample, so no output depends on the command of the same time.
ESTIMATED_FROM: Dependencies = dict.fromkeys(OUTPUT_NAMES, ("psi", "psi_dot", "ax", "x_meas", "y_meas", "fix"))
NUMERIC_PARAMETERS = [p for p in parameters_of(Hovercraft) if not isinstance(p.default, bool)]
FIX_AXES = "fixes are along the craft's own axes, or the world's: own, world"


class Estimator(SampledSlave):
    """Sampled estimator: a communication step is one sample; other steps than `sample_time` are rejected."""

    who = "estimator"

    def process(self) -> None:
        """Process one sample."""
        *both, x_meas, y_meas, fix = self.inputs
        self.running.step(both[:3], both[3:], fix, (x_meas, y_meas))


class HovercraftFilter(Estimator):
    """Kalman filter of the thesis in three variants, or double integration, by parameter `estimator`."""

    about = "Estimators of the hovercraft: three Kalman filters, double integration"
    parts = ("observers:LinearFilter", DESIGN_MODEL, "observers:DoubleIntegration")
    settings = FilterSettings()
    ports = (
        *SIGNAL_PORTS,
        *settings_ports(settings, "estimator", f"estimator: {', '.join(settings.choices['estimator'])}"),
    )
    depends = ESTIMATED_FROM, all_dependencies(ports)[1]

    def start(self, settings: Any, x_hat: list[float], given: dict[str, Value]) -> Any:
        """Return the filter or double integration."""
        kind: Any = DoubleIntegration if settings.estimator == DOUBLE_INTEGRATION else LinearFilter
        return kind(settings, x_hat, self.inputs[-1])


class HovercraftEkf(Estimator):
    """Extended Kalman filter with the plant's equations as an FMU."""

    about = "Extended Kalman filter of the hovercraft on the plant's equations"
    parts = ("observers:ExtendedFilter",)
    needs_jacobians = True
    settings = ExtendedSettings()
    ports = (
        *SIGNAL_PORTS,
        *(parameter_port(p, p.default) for p in NUMERIC_PARAMETERS),
        *settings_ports(settings, "axes", FIX_AXES),
    )
    depends = ESTIMATED_FROM, all_dependencies(ports)[1]

    def start(self, settings: Any, x_hat: list[float], given: dict[str, Value]) -> ExtendedFilter:
        """Return the filter; both propellers start at the tilt of acceleration a_hat_start."""
        from controller import printed  # type: ignore[attr-defined]  # printed when the FMU is built

        model = Hovercraft().with_values({p.name: given[p.name] for p in NUMERIC_PARAMETERS if p.name in given})
        start = dict(zip(ESTIMATE_MEANINGS, x_hat, strict=True))
        tilt = level_tilt(model, start.pop("a"))
        start |= {"tilt_right": tilt, "tilt_left": tilt}
        return ExtendedFilter(model, settings, vars(printed), start, self.inputs[-1])
