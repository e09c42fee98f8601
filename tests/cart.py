"""An FMU of another hand: a cart on a rail, built with pythonfmu as anybody would."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from pythonfmu.builder import FmuBuilder

CART = '''
from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class Cart(Fmi2Slave):
    """A cart of 2 kg with viscous friction of 1 N s/m, v(t + h) by Euler's rule."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.force, self.position, self.velocity = 0.0, 0.0, 0.0
        self.position_start, self.velocity_start = 0.0, 0.0
        self.register_variable(Real("force", causality=Fmi2Causality.input))
        self.register_variable(Real("position", causality=Fmi2Causality.output))
        self.register_variable(Real("velocity", causality=Fmi2Causality.output))
        for name in ("position_start", "velocity_start")[: {starts}]:
            self.register_variable(Real(name, causality=Fmi2Causality.parameter, variability=Fmi2Variability.fixed))

    def exit_initialization_mode(self):
        self.position, self.velocity = self.position_start, self.velocity_start

    enter_initialization_mode = exit_initialization_mode

    def do_step(self, current_time, step_size):
        {first}
        self.position += step_size * self.velocity
        self.velocity += step_size * (self.force - self.velocity) / 2.0
        return True
'''


def built(script: Path, fmu: Path, **options: Any) -> Path:
    """Build an FMU of a script, and forget its modules: one process keeps one of a name."""
    path, modules = list(sys.path), set(sys.modules)
    sys.path.insert(0, str(script.parent))
    try:
        return Path(FmuBuilder.build_FMU(script, fmu, **options))
    finally:
        sys.path[:] = path
        for module in set(sys.modules) - modules:
            if Path(getattr(sys.modules[module], "__file__", None) or "/").parent == script.parent:
                del sys.modules[module]


def cart_fmu(folder: Path, starts: int = 2, variable_step: bool = True, first: str = "pass") -> Path:
    """Build the cart; its initial outputs follow the start values when initialization ends; a step does `first`."""
    script = folder / f"cart_{starts}.py"
    script.write_text(CART.replace("{starts}", str(starts)).replace("{first}", first))
    return built(script, folder / "Cart.fmu", canHandleVariableCommunicationStepSize=variable_step)
