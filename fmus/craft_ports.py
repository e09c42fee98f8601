"""FMI variables and sampling common to controller and estimators of the craft."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, ClassVar

from cosim.fmi.ports import Port
from cosim.fmi.slave import Slave

ESTIMATED = {  # name → unit, meaning
    "x": ("m", "distance along the craft's own axis"),
    "vx": ("m/s", "forward velocity"),
    "psi": ("rad", "heading"),
    "psi_dot": ("rad/s", "yaw rate"),
    "a": ("m/s2", "thrust acceleration"),
}
ESTIMATE = tuple(f"{name}_hat" for name in ESTIMATED)
MEASURED = (
    Port("psi", "input", 0.0, "rad", "measured heading, positive to the left"),
    Port("psi_dot", "input", 0.0, "rad/s", "measured yaw rate"),
    Port("ax", "input", 0.0, "m/s2", "measured forward acceleration"),
)
ESTIMATES = tuple(
    Port(f"{name}_hat", "output", 0.0, unit, f"estimated {doc}") for name, (unit, doc) in ESTIMATED.items()
)


FIXES = (
    Port("x_meas", "input", 0.0, "m", "fix of x, the distance along the craft's own axis", optional=True),
    Port("y_meas", "input", 0.0, "m", "fix of y, the drift to the right", optional=True),
    Port("fix", "input", 0.0, "1", "number of the latest fix, 0 before the first; a new one is used", optional=True),
)
SIGMA = tuple(
    Port(f"{name}_sigma", "output", 0.0, unit, f"standard deviation of {name}_hat the estimator believes in")
    for name, unit in (("x", "m"), ("psi", "rad"))
)
STARTS = tuple(
    Port(f"{p.name}_start", "parameter", 0.0, p.unit, f"start value of {p.name}; the estimator knows where it starts")
    for p in ESTIMATES
)


class SampledSlave(Slave):
    """Sampled slave: a communication step is one sample; a step other than `sample_time` is refused.

    Attributes:
        who: Noun for messages.
        sample: Sample time [s].
        running: What runs, with the complete state.
    """

    who: ClassVar[str]
    sample: float
    running: Any

    def settings_of(self, kind: Any) -> Any:
        """Return an object of a dataclass with the values of the variables that are named as its fields."""
        names = {field.name for field in fields(kind)}
        values = zip((port.name for port in self.ports), self.values, strict=True)
        return kind(**{name: value for name, value in values if name in names})

    def check_sample(self, h: float) -> None:
        """Raise ValueError for a step that is no sample."""
        if abs(h - self.sample) > 1e-6 * self.sample:
            raise ValueError(f"step of {h} s; the {self.who} is sampled at {self.sample} s (parameter sample_time)")

    def snapshot(self) -> Any:
        """Return estimate, covariance, last command and last fix."""
        return self.running.snapshot()

    def restore(self, snapshot: Any) -> None:
        """Restore a snapshot exactly."""
        self.running.restore(snapshot)
