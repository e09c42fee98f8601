"""Controller as an FMI slave: Kalman filter with filterpy, LQR, saturation, reference inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

from pythonfmu.enums import Fmi2Status

from controller.gains import Settings
from controller.laws import Law, StateFeedback
from controller.loop import Loop
from cosim.fmi.ports import Port, Value, parameter_port
from cosim.fmi.slave import STEP, Slave
from cosim.model import parameters_of
from fmus.craft_ports import ESTIMATE, ESTIMATES, MEASURED, fix_ports, sigma_ports, start_ports


def controller_ports(settings: Settings) -> tuple[Port, ...]:
    """Return all variables of the controller FMU: inputs, outputs, parameters and start values."""
    duty = settings.duty_nominal
    return (
        *MEASURED,
        Port("x_ref", "input", 0.0, "m", "reference of the distance along the craft's own axis"),
        Port("psi_ref", "input", 0.0, "rad", "reference of the heading"),
        *fix_ports("; the five states know none"),
        Port("duty_right", "output", duty, "%", "duty command of the right motor"),
        Port("duty_left", "output", duty, "%", "duty command of the left motor"),
        Port("tilt_right", "output", 0.0, "rad", "tilt command of the right propeller, saturated"),
        Port("tilt_left", "output", 0.0, "rad", "tilt command of the left propeller, saturated"),
        *ESTIMATES,
        *sigma_ports("filter"),
        *(parameter_port(p, getattr(settings, p.name)) for p in parameters_of(settings)),
        Port("estimator", "parameter", settings.estimator, "", f"Kalman filter: {_either(settings.estimators)}"),
        *start_ports("filter"),
    )


def _either(names: Sequence[str]) -> str:
    """Return a readable list of alternatives."""
    *first, last = names
    return f"{', '.join(first)} or {last}" if first else last


# Dependencies of outputs at a sample. The axes are decoupled; of the inputs, only a fix changes the covariance.
FORWARD, TURN = ("ax", "x_meas", "fix"), ("psi", "psi_dot")
DEPENDENCIES: dict[str, tuple[str, ...]] = {
    "duty_right": (),
    "duty_left": (),
    "tilt_right": (*TURN, *FORWARD, "x_ref", "psi_ref"),
    "tilt_left": (*TURN, *FORWARD, "x_ref", "psi_ref"),
    "x_hat": FORWARD,
    "vx_hat": FORWARD,
    "a_hat": FORWARD,
    "psi_hat": TURN,
    "psi_dot_hat": TURN,
    "x_sigma": ("fix",),
    "psi_sigma": (),
}
# Dependencies in initialization mode, without filter update and with P = 0.
INITIAL_DEPENDENCIES: dict[str, tuple[str, ...]] = {
    "duty_right": ("duty_nominal",),
    "duty_left": ("duty_nominal",),
    **{
        f"tilt_{side}": (
            "x_ref",
            "psi_ref",
            "tilt_max",
            *(f"k_{row}_{j}" for j in range(1, 6)),
            *(f"{name}_start" for name in ESTIMATE),
        )
        for row, side in ((1, "right"), (2, "left"))
    },
    **{name: (f"{name}_start",) for name in ESTIMATE},
    "x_sigma": (),
    "psi_sigma": (),
}


class HovercraftController(Slave):
    """Sampled controller: a communication step is one sample; a step other than `sample_time` is refused.

    The hosting Python needs numpy, scipy and filterpy. The filter starts at `*_hat_start`.
    """

    settings: ClassVar[Settings] = Settings()  # default values
    ports = controller_ports(settings)

    def law(self, settings: Any, given: dict[str, Value]) -> Law:
        """Return the control law for parameters and start values of the host."""
        return StateFeedback(settings)

    def initialize(self, given: dict[str, Value]) -> None:
        """Start the control loop; its filter starts at `*_hat_start` with P = 0, without an update."""
        names = {p.name for p in parameters_of(self.settings)} | {"estimator"}
        every = dict(zip((port.name for port in self.ports), self.values, strict=True))
        values: dict[str, Any] = {name: v for name, v in every.items() if name in names}
        settings = replace(self.settings, **values)
        x_hat = [float(given.get(f"{name}_start", 0.0)) for name in ESTIMATE]
        _, _, _, x_ref, psi_ref, _, _, fix, *y_ref = self.inputs
        law = self.law(settings, given)
        self.loop = Loop(settings, x_hat, x_ref, psi_ref, fix, y_ref=sum(y_ref), law=law)
        self._publish()

    def advance(self, t: float, h: float) -> None:
        """Process one sample."""
        sample = self.loop.settings.sample_time
        if abs(h - sample) > 1e-6 * sample:
            raise ValueError(f"step of {h} s; the controller is sampled at {sample} s (parameter sample_time)")
        # y_ref exists only for laws with y
        psi, psi_dot, ax, x_ref, psi_ref, x_meas, y_meas, fix, *y_ref = self.inputs
        self.loop.step((psi, psi_dot, ax), x_ref, psi_ref, fix, x_meas, y_meas=y_meas, y_ref=sum(y_ref))
        self._publish()

    def terminate(self) -> None:
        """Log the control law's remarks on the run as a warning."""
        if self.phase is STEP and (words := self.loop.law.words(self.start_time)):
            self.log(words, Fmi2Status.warning)

    def snapshot(self) -> Any:
        """Return estimate, covariance, last command and last fix."""
        return self.loop.snapshot()

    def restore(self, snapshot: Any) -> None:
        """Restore a snapshot exactly."""
        self.loop.restore(snapshot)

    def _publish(self) -> None:
        loop = self.loop
        self.set_outputs([*loop.law.duties, *loop.command, *loop.estimate, *loop.sigma, *loop.law.outputs()])
