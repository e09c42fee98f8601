"""A tank as an FMU of another tool: `pythonfmu build -f examples/tanks/tank.py --dest build`."""

from math import sqrt
from typing import Any

from pythonfmu import DefaultExperiment, Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class Tank(Fmi2Slave):
    """A·dh/dt = q − c·√h, by Euler's method in steps of 10 ms at most; h [m], q [m3/s]."""

    description = "A tank with an outlet"
    default_experiment = DefaultExperiment(start_time=0.0, stop_time=400.0, step_size=0.5)

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        self.inflow, self.level, self.level_start, self.area, self.outlet = 0.02, 1.0, 1.0, 0.5, 0.02
        self.register_variable(Real("inflow", causality=Fmi2Causality.input, description="flow in, m3/s"))
        self.register_variable(Real("level", causality=Fmi2Causality.output, description="level of the water, m"))
        for name, what in (("level_start", "level at first, m"), ("area", "of the surface, m2"), ("outlet", "c")):
            fixed = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.fixed}
            self.register_variable(Real(name, description=what, **fixed))

    def exit_initialization_mode(self) -> None:
        """Set the level to its start value."""
        self.level = self.level_start

    def do_step(self, current_time: float, step_size: float) -> bool:
        """One communication step."""
        parts = max(1, round(step_size / 0.01))
        for _ in range(parts):
            self.level += step_size / parts * (self.inflow - self.outlet * sqrt(max(self.level, 0.0))) / self.area
        return True
