"""A model as an FMI slave; it uses only the standard library and pythonfmu's module."""

from __future__ import annotations

from typing import Any, ClassVar

from pythonfmu.enums import Fmi2Status

from cosim.fmi.ports import Value
from cosim.fmi.slave import Slave, tuples
from cosim.model.integrate import Moment, Stepper
from cosim.model.model import Model


class ModelSlave(Slave):
    """A `cosim.model.model.Model` as a slave. Effects that are dormant at initialization are left out."""

    model: ClassVar[Model]

    def initialize(self, values: dict[str, Value]) -> None:
        """Build the model from the defaults and the values that the host has set."""
        starts = {name.removesuffix("_start"): v for name, v in values.items() if name.endswith("_start")}
        signals = {q.name for q in self.model.inputs}
        model = self.model.with_values(
            {name: v for name, v in values.items() if not name.endswith("_start") and name not in signals}
        )
        self.stepper = Stepper(model)
        self.has_warned = False
        self.moment = self.stepper.start(self.start_time, starts)
        for vr, (q, start) in enumerate(zip(model.inputs, model.start_command(), strict=True)):
            if q.name not in values:
                self.values[vr] = start
        self.follow_inputs()

    def advance(self, t: float, h: float) -> None:
        """Integrate over the step `h` from time `t` [s]."""
        if not self.has_warned and (warning := self.stepper.model.warning(self.inputs)):
            self.has_warned = True
            self.log(f"at t = {t:g} s: {warning}", Fmi2Status.warning)
        moment = Moment(t, self.moment.state, self.moment.memory)
        try:
            self.moment = self.stepper.step(moment, self.inputs, h)
        except (ArithmeticError, ValueError) as error:  # e.g. sine of infinity, or an overflow
            model = self.stepper.model
            quantities = [*zip(model.inputs, self.inputs, strict=True), *zip(model.states, moment.state, strict=True)]
            largest, value = max(((q.name, v) for q, v in quantities), key=lambda pair: abs(pair[1]))
            message = f"the state is not finite after the step; the largest state before it: {largest} = {value:g}"
            raise ArithmeticError(message) from error
        self.follow_inputs()

    def follow_inputs(self) -> None:
        """Write the outputs for the current state and the new inputs."""
        self.set_outputs(self.stepper.output(self.moment.t, self.moment.state, self.inputs))

    def snapshot(self) -> Any:
        """Return time, continuous state and memory."""
        return [self.moment.t, self.moment.state, self.moment.memory]

    def restore(self, snapshot: Any) -> None:
        """Restore a snapshot exactly."""
        self.moment = Moment(*tuples(snapshot))
