"""Controllers as FMI slaves: an estimator with a control law, saturation, reference inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from pythonfmu.enums import Fmi2Status

from controller.laws import IntegralFeedback, Law, StateFeedback
from controller.loop import Loop
from controller.settings import (
    INTEGRAL_SETTINGS,
    PLACED_SETTINGS,
    PredictiveSettings,
    Settings,
    TimeVariantSettings,
)
from cosim.fmi.ports import Port, Value, parameter_port
from cosim.fmi.slave import STEP
from cosim.model import parameters_of
from fmus.craft_ports import ESTIMATE, ESTIMATES, FIXES, MEASURED, SIGMA, STARTS, SampledSlave

Dependencies = Mapping[str, Sequence[str]]
INTEGRALS = (
    Port("x_integral", "output", 0.0, "m.s", "integral of the error of the measured position"),
    Port("psi_integral", "output", 0.0, "rad.s", "integral of the error of the measured heading"),
)
LATERAL = (
    Port("y_ref", "input", 0.0, "m", "reference of the drift to the right", optional=True),
    Port("y_hat", "output", 0.0, "m", "estimated drift to the right"),
    Port("y_sigma", "output", 0.0, "m", "standard deviation of y_hat the filter believes in"),
    Port("iterations", "output", 0.0, "1", "iterations of the solver at this sample"),
    Port("solved", "output", 1.0, "1", "1 where the solver ended in a solution, 0 by its limit of iterations"),
    Port("y_hat_start", "parameter", 0.0, "m", "start value of y_hat; the filter knows where it starts"),
)


def controller_ports(settings: Settings, *more: Port) -> tuple[Port, ...]:
    """Return all variables of a controller FMU: inputs, outputs, parameters and start values."""
    duty = settings.duty_nominal
    every = (
        *MEASURED,
        Port("x_ref", "input", 0.0, "m", "reference of the distance along the craft's own axis"),
        Port("psi_ref", "input", 0.0, "rad", "reference of the heading"),
        *FIXES,
        Port("duty_right", "output", duty, "%", "duty command of the right motor"),
        Port("duty_left", "output", duty, "%", "duty command of the left motor"),
        Port("tilt_right", "output", 0.0, "rad", "tilt command of the right propeller, saturated"),
        Port("tilt_left", "output", 0.0, "rad", "tilt command of the left propeller, saturated"),
        *ESTIMATES,
        *SIGMA,
        *(parameter_port(p, getattr(settings, p.name)) for p in parameters_of(settings)),
        Port("estimator", "parameter", settings.estimator, "", f"Kalman filter: {', '.join(settings.estimators)}"),
        *STARTS,
        *more,
    )
    return tuple(p for causality in ("input", "output", "parameter") for p in every if p.causality == causality)


START_NAMES = tuple(port.name for port in STARTS)
# Dependencies of outputs at a sample. The axes are decoupled; of the inputs, only a fix changes the covariance.
FORWARD, TURN = ("ax", "x_meas", "fix"), ("psi", "psi_dot")
TILTS = (*TURN, *FORWARD, "x_ref", "psi_ref")
DEPENDENCIES: Dependencies = {
    **dict.fromkeys(("duty_right", "duty_left", "psi_sigma"), ()),
    **dict.fromkeys(("tilt_right", "tilt_left"), TILTS),
    **dict.fromkeys(("x_hat", "vx_hat", "a_hat"), FORWARD),
    **dict.fromkeys(("psi_hat", "psi_dot_hat"), TURN),
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


class HovercraftController(SampledSlave):
    """Sampled controller: a communication step is one sample; a step other than `sample_time` is refused.

    The hosting Python needs numpy, scipy and filterpy. The filter starts at `*_hat_start`.

    Attributes:
        settings: Default values.
        depends: Dependencies of outputs at a sample, and in initialization mode.
    """

    who = "controller"
    settings: ClassVar[Settings] = Settings()
    ports = controller_ports(settings)
    depends: ClassVar[tuple[Dependencies, Dependencies]] = (DEPENDENCIES, INITIAL_DEPENDENCIES)

    def law(self, settings: Any, given: dict[str, Value]) -> Law:
        """Return the control law for parameters and start values of the host."""
        return StateFeedback(settings)

    def initialize(self, given: dict[str, Value]) -> None:
        """Start the control loop; its filter starts at `*_hat_start` with P = 0, without an update."""
        settings = self.settings_of(type(self.settings))
        x_hat = [float(given.get(name, 0.0)) for name in START_NAMES]
        _, _, _, x_ref, psi_ref, _, _, fix, *y_ref = self.inputs  # y_ref exists only for laws with y
        law = self.law(settings, given)
        self.sample = settings.sample_time
        self.running = Loop(settings, x_hat, x_ref, psi_ref, fix, y_ref=sum(y_ref), law=law)
        self._publish()

    def advance(self, t: float, h: float) -> None:
        """Process one sample."""
        self.check_sample(h)
        psi, psi_dot, ax, x_ref, psi_ref, x_meas, y_meas, fix, *y_ref = self.inputs
        self.running.step((psi, psi_dot, ax), x_ref, psi_ref, fix, x_meas, y_meas=y_meas, y_ref=sum(y_ref))
        self._publish()

    def terminate(self) -> None:
        """Log the control law's remarks on the run as a warning."""
        if self.phase is STEP and (words := self.running.law.words(self.start_time)):
            self.log(words, Fmi2Status.warning)

    def _publish(self) -> None:
        loop = self.running
        self.set_outputs([*loop.law.duties, *loop.command, *loop.estimate, *loop.sigma, *loop.law.outputs()])


class HovercraftPolesController(HovercraftController):
    """Pole placement: −2, −4, −11 rad/s of the forward axis, −4, −5 rad/s of the turn.

    The common tilt drives the forward axis, the tilt difference the turn, so that the gain of each is unique. At most
    two poles are equal, one in each axis.
    """

    settings = PLACED_SETTINGS
    ports = controller_ports(settings)


class HovercraftIntegralController(HovercraftController):
    """LQR with integral action on measured errors: of x from position fixes, of ψ from the IMU."""

    settings = INTEGRAL_SETTINGS
    ports = controller_ports(settings, *INTEGRALS)
    # saturation of a tilt affects both integrals
    depends = (
        {**DEPENDENCIES, **dict.fromkeys(("x_integral", "psi_integral"), TILTS)},
        {**INITIAL_DEPENDENCIES, "x_integral": (), "psi_integral": ()},
    )

    def law(self, settings: Any, given: dict[str, Value]) -> Law:
        """Return state feedback with integrals."""
        return IntegralFeedback(settings)


def predictive_dependencies(ports: Sequence[Port], *, own_filter: bool = False) -> tuple[Dependencies, Dependencies]:
    """Return output dependencies; commands depend on all inputs and parameters, with an own filter all estimates."""
    inputs = tuple(p.name for p in ports if p.causality == "input")
    parameters = [p.name for p in ports if p.causality == "parameter" and p.kind == "Real"]
    known = ("x_ref", "psi_ref", "y_ref", *(name for name in parameters if not name.startswith("k_")))
    solved = ("duty_right", "duty_left", "tilt_right", "tilt_left", "iterations", "solved")
    at_sample = {**DEPENDENCIES, "y_hat": ("y_meas", "fix"), "y_sigma": ("fix",), **dict.fromkeys(solved, inputs)}
    at_start = {**INITIAL_DEPENDENCIES, "y_hat": ("y_hat_start",), "y_sigma": (), **dict.fromkeys(solved, known)}
    if own_filter:
        estimates = (*ESTIMATE, "x_sigma", "psi_sigma", "y_hat", "y_sigma")
        at_sample |= dict.fromkeys(estimates, tuple(n for n in inputs if not n.endswith("_ref")))
        at_start["a_hat"] = tuple(n for n in known if not n.endswith("_ref"))
    return at_sample, at_start


class HovercraftPredictiveController(HovercraftController):
    """Model predictive control with limits of tilt and duty, and with control of y by position fixes.

    The host also needs the solver daqp.
    """

    settings = PredictiveSettings()
    ports = controller_ports(settings, *LATERAL)
    depends = predictive_dependencies(ports)

    def law(self, settings: Any, given: dict[str, Value]) -> Law:
        """Return the predictive law.

        The solver is imported here, since other controllers do not need it.
        """
        from controller.predictive import PredictiveLaw

        return PredictiveLaw(settings, float(given.get("y_hat_start", 0.0)))


class HovercraftTimeVariantController(HovercraftController):
    """Predictive control with A(t), B(t) along the planned motion, and its own extended Kalman filter.

    Tilt and duty are limited. With position fixes, y is controlled too. The host also needs the solver daqp.
    """

    settings = TimeVariantSettings()
    ports = controller_ports(settings, *LATERAL)
    depends = predictive_dependencies(ports, own_filter=True)

    def law(self, settings: Any, given: dict[str, Value]) -> Law:
        """Return the time-variant law, with the Jacobian functions that were printed when the FMU was built."""
        from controller import printed  # type: ignore[attr-defined]
        from controller.predictive import TimeVariantLaw

        return TimeVariantLaw(settings, vars(printed), float(given.get("y_hat_start", 0.0)))
