"""Estimators as FMI slaves with common inputs and outputs, exchangeable by one line of a scenario.

Like the controller, they need numpy, scipy and filterpy in the hosting Python.
"""

from __future__ import annotations

from typing import Any, ClassVar

from controller.extended import ExtendedFilter, level_tilt
from controller.observers import DoubleIntegration, LinearFilter
from controller.settings import DOUBLE_INTEGRATION, ESTIMATORS, ExtendedSettings, FilterSettings
from cosim.fmi.ports import Port, Value, parameter_port
from cosim.model import parameters_of
from fmus.craft_ports import ESTIMATE, ESTIMATES, FIXES, SIGMA, STARTS, SampledSlave
from fmus.craft_ports import MEASURED as IMU
from plant.hovercraft import DUTY_NOMINAL, Hovercraft

NIS = "normalised innovation squared of (psi, psi_dot, ax), 3 in the mean where it is right"
SIGNALS = (
    *IMU,
    Port("duty_right", "input", DUTY_NOMINAL, "%", "duty command of the right motor, as it has acted"),
    Port("duty_left", "input", DUTY_NOMINAL, "%", "duty command of the left motor, as it has acted"),
    Port("tilt_right", "input", 0.0, "rad", "tilt command of the right propeller, as it has acted"),
    Port("tilt_left", "input", 0.0, "rad", "tilt command of the left propeller, as it has acted"),
    *FIXES,
    *ESTIMATES,
    Port("y_hat", "output", 0.0, "m", "estimated drift to the right; 0 where it is not estimated"),
    *SIGMA,
    Port("y_sigma", "output", 0.0, "m", "standard deviation of y_hat the estimator believes in"),
    Port("nis", "output", 0.0, "1", NIS),
)
INPUTS = tuple(p.name for p in SIGNALS if p.causality == "input")
OUTPUTS = tuple(p.name for p in SIGNALS if p.causality == "output")
MEASURED = ("psi", "psi_dot", "ax", "x_meas", "y_meas", "fix")
Dependencies = dict[str, tuple[str, ...]]
# A command acts until the sample, so no output depends on the command of the same time.
DEPENDENCIES: Dependencies = dict.fromkeys(OUTPUTS, MEASURED)
INITIAL_DEPENDENCIES: Dependencies = dict.fromkeys(OUTPUTS, ()) | {n: (f"{n}_start",) for n in ESTIMATE}
NUMBERS = [p for p in parameters_of(Hovercraft) if not isinstance(p.default, bool)]
FIX_AXES = "fixes are along the craft's own axes, or the world's: own, world"


class Estimator(SampledSlave):
    """Sampled estimator: a communication step is one sample; a step other than `sample_time` is refused."""

    who = "estimator"
    depends: ClassVar[tuple[Dependencies, Dependencies]] = (DEPENDENCIES, INITIAL_DEPENDENCIES)

    def advance(self, t: float, h: float) -> None:
        """Process one sample."""
        self.check_sample(h)
        *both, x_meas, y_meas, fix = self.inputs
        self.running.step(both[:3], both[3:], fix, (x_meas, y_meas))
        self._publish()

    def _publish(self) -> None:
        self.set_outputs([*self.running.estimate, *self.running.sigma, self.running.nis])


class HovercraftFilter(Estimator):
    """Kalman filter of the thesis in three variants, or double integration, by parameter `estimator`."""

    ports: ClassVar[tuple[Port, ...]] = (
        *SIGNALS,
        *(parameter_port(p, p.default) for p in parameters_of(FilterSettings)),
        Port("estimator", "parameter", ESTIMATORS[0], "", f"estimator: {', '.join(FilterSettings.estimators)}"),
        *STARTS,
    )

    def initialize(self, given: dict[str, Value]) -> None:
        """Start the estimator at `*_hat_start` with P = 0, without an update."""
        settings = self.settings_of(FilterSettings)
        kind: Any = DoubleIntegration if settings.estimator == DOUBLE_INTEGRATION else LinearFilter
        self.sample = settings.sample_time
        self.running = kind(settings, [float(given.get(f"{n}_start", 0.0)) for n in ESTIMATE], self.inputs[-1])
        self._publish()


class HovercraftEkf(Estimator):
    """Extended Kalman filter with the plant's equations as an FMU."""

    ports: ClassVar[tuple[Port, ...]] = (
        *SIGNALS,
        *(parameter_port(p, p.default) for p in NUMBERS),
        *(parameter_port(p, p.default) for p in parameters_of(ExtendedSettings)),
        Port("axes", "parameter", ExtendedSettings().axes, "", FIX_AXES),
        *STARTS,
    )
    # The acceleration at the start also depends on plant parameters.
    depends = DEPENDENCIES, INITIAL_DEPENDENCIES | {"a_hat": tuple(p.name for p in ports if p.causality == "parameter")}

    def initialize(self, given: dict[str, Value]) -> None:
        """Start the estimate at `*_hat_start` with P = 0, without update.

        Both propellers start at the tilt of acceleration a_hat_start.
        """
        from controller import printed  # type: ignore[attr-defined]  # printed when the FMU is built

        model = Hovercraft().with_values({p.name: given[p.name] for p in NUMBERS if p.name in given})
        settings = self.settings_of(ExtendedSettings)
        start = {n.removesuffix("_hat"): float(given.get(f"{n}_start", 0.0)) for n in ESTIMATE}
        tilt = level_tilt(model, start.pop("a"))
        start |= {"tilt_right": tilt, "tilt_left": tilt}
        self.sample = settings.sample_time
        self.running = ExtendedFilter(model, settings, vars(printed), start, self.inputs[-1])
        self._publish()
