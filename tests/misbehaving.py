"""FMUs that do something wrong at a given step, built with pythonfmu as anybody would."""

from __future__ import annotations

import sys
from pathlib import Path

from pythonfmu.builder import FmuBuilder

SOURCE = '''
from pythonfmu import Fmi2Causality, Fmi2Slave, Real


class {name}(Fmi2Slave):
    """Counts its steps and, at step {at}, does this: {what}."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.u, self.y, self.z, self.steps = 0.0, 0.0, 0.0, 0
        self.register_variable(Real("u", causality=Fmi2Causality.input))
        self.register_variable(Real("y", causality=Fmi2Causality.output))
        self.register_variable(Real("z", causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        self.steps += 1
        self.y = float(self.steps)
        if self.steps == {at}:
            {what}
        return True
'''
FAULTS = {
    "Raises": "raise RuntimeError('the bearing seized')",
    "Behaves": "pass",
}


def misbehaving_fmu(folder: Path, name: str, at: int = 5) -> Path:
    """Build the FMU `name` of `FAULTS` in `folder`."""
    script = folder / f"{name.lower()}.py"
    script.write_text(SOURCE.format(name=name, at=at, what=FAULTS[name]))
    path, modules = list(sys.path), set(sys.modules)
    try:
        return Path(FmuBuilder.build_FMU(script, folder / f"{name}.fmu"))
    finally:
        sys.path[:] = path
        for module in set(sys.modules) - modules:
            if module == script.stem:
                del sys.modules[module]
