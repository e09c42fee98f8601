"""An FMU of another hand: a cart on a rail, built with pythonfmu as anybody would."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path

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
        self.position += step_size * self.velocity
        self.velocity += step_size * (self.force - self.velocity) / 2.0
        return True
'''


def cart_fmu(folder: Path, starts: int = 2, variable_step: bool = True) -> Path:
    """Build the cart; its initial outputs follow the start values when initialization ends."""
    script = folder / f"cart_{starts}.py"  # one process keeps one module of a name
    script.write_text(CART.replace("{starts}", str(starts)))
    path, modules = list(sys.path), set(sys.modules)
    try:
        fmu = Path(FmuBuilder.build_FMU(script, folder / "Cart.fmu"))
    finally:
        sys.path[:] = path
        for module in set(sys.modules) - modules & {script.stem}:
            del sys.modules[module]
    return fmu if variable_step else with_equal_steps(fmu)


def with_equal_steps(fmu: Path) -> Path:
    """Return the same FMU with a declaration that it accepts equal steps only."""
    with zipfile.ZipFile(fmu) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    flag = b'canHandleVariableCommunicationStepSize="true"'
    assert flag in files["modelDescription.xml"]
    files["modelDescription.xml"] = files["modelDescription.xml"].replace(flag, flag.replace(b"true", b"false"))
    with zipfile.ZipFile(fmu, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return fmu
