"""Its controller as an FMU of another tool: `pythonfmu build -f examples/tanks/level_control.py --dest build`."""

from typing import Any

from pythonfmu import DefaultExperiment, Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class Controller(Fmi2Slave):
    """q = k·(wanted − h) + i·∫(wanted − h) dt, between nothing and what the pump gives [m3/s]."""

    description = "A level controller"
    default_experiment = DefaultExperiment(start_time=0.0, stop_time=400.0, step_size=0.5)

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        self.level, self.wanted, self.pump_flow, self.gain, self.reset, self.most = 1.0, 1.5, 0.02, 0.05, 0.001, 0.05
        self.sum = 0.0
        self.register_variable(Real("level", causality=Fmi2Causality.input, description="level measured, m"))
        self.register_variable(Real("wanted", causality=Fmi2Causality.input, description="level wanted, m"))
        self.register_variable(Real("pump_flow", causality=Fmi2Causality.output, description="flow of the pump, m3/s"))
        for name, what in (("gain", "k, m2/s"), ("reset", "i, m2/s2"), ("most", "the pump gives, m3/s")):
            fixed = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.fixed}
            self.register_variable(Real(name, description=what, **fixed))

    def do_step(self, current_time: float, step_size: float) -> bool:
        """One communication step; the sum rests while the pump can give no more."""
        off = self.wanted - self.level
        flow = self.gain * off + self.reset * (self.sum + off * step_size)
        self.pump_flow = min(self.most, max(0.0, flow))
        if flow == self.pump_flow:
            self.sum += off * step_size
        return True
