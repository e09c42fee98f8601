"""Components computed for many runs at once: sources, models with equations carried by their FMU, and controllers.

A twin computes its FMU's results on arrays with a value per run. Without a twin, `kind_of` returns None and the runs
use the FMU.
"""

from __future__ import annotations

import importlib
import sys
import tempfile
import zipfile
from collections.abc import Hashable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from cosim.base.arrays import Array
from cosim.base.registry import models, resolve, twin_of
from cosim.base.scratch import process_folder
from cosim.blocks.component import Component
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.sources import SourceBlock
from cosim.model.quantities import parameters_of
from cosim.storage.archive import unpack
from cosim.sweeps.c_lanes import compile_model

Values = Mapping[str, Any]  # variable → value, or an array over the runs


class Twin(Protocol):
    """Interface of a component that computes many runs at once on arrays.

    Its inputs and outputs are views of the rows of the stepping loop, shape (signals, runs).
    """

    def begin(self, inputs: Array, outputs: Array, t: float) -> None:
        """Set the views of inputs and outputs, and the start values of unconnected inputs."""

    def settle(self) -> None:
        """Compute the outputs of initialization from the inputs."""

    def advance(self, t: float, h: float) -> None:
        """Step from `t` to `t + h` [s] and write the outputs."""


class TwinMaker(Protocol):
    """A maker of twins for a component."""

    def pattern(self, values: Values) -> Hashable:
        """Return a key; runs with equal keys are made together."""

    def make(self, values: Values, count: int, *, compiled: bool) -> Twin:
        """Return a twin of `count` runs, compiled if possible."""


def kind_of(component: Component) -> TwinMaker | None:
    """Return a component's maker of twins, if any."""
    if isinstance(component, SourceBlock):
        return _SourceTwin(component)
    if not isinstance(component, FmuBlock):
        return None
    if component.exact_inputs or component.exact_outputs:
        return None
    name = component.description.modelName
    if (twin := twin_of(name)) is not None:
        kind = twin()
    elif (model := model_of(component.path, name)) is not None:
        kind = _ModelKind(component, *model)
    else:
        return None
    return kind if kind.fits(component) else None


class _SourceTwin:
    """Array twin of a source, whose values are equal in every run; it also makes such twins."""

    def __init__(self, source: SourceBlock) -> None:
        self.source = source

    def pattern(self, values: Values) -> Hashable:
        return ()

    def make(self, values: Values, count: int, *, compiled: bool) -> Twin:
        return _SourceTwin(self.source)

    def begin(self, inputs: Array, outputs: Array, t: float) -> None:
        self.outputs, self.t = outputs, t

    def settle(self) -> None:
        _fill(self.outputs, [function(self.t) for function in self.source.functions])

    def advance(self, t: float, h: float) -> None:
        self.t = t + h
        self.settle()


@cache
def model_of(path: Path, name: str) -> tuple[Any, Any, Any] | None:
    """Return an FMU's model, its stepper and array namespace.

    An FMU in Python carries its equations; a native FMU of a registered model uses the installed ones. The result is
    None for others.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            script = archive.read("resources/slavemodule.txt").decode().strip()
    except (OSError, KeyError, ValueError, zipfile.BadZipFile):
        return _registered_model(name)
    folder = unpack_once(path) / "resources"
    package = script.removesuffix("_slave")
    # Earlier releases carried the modelling language as `plant`.
    for language in ("cosim.model", "plant"):
        if (folder / package / language.replace(".", "/") / "integrate.py").is_file():
            break
    else:
        return None  # a foreign FMU
    sys.path.insert(0, str(folder))
    try:
        slave = getattr(importlib.import_module(script), name, None)
        model = getattr(slave, "model", None)
        if model is None:
            return None
        integrate, spaces = (importlib.import_module(f"{package}.{language}.{n}") for n in ("integrate", "namespaces"))
        return model, integrate.Stepper, spaces.arrays()
    except Exception:  # Foreign code may fail in any way; the runs then use the FMU, which reports the error.
        return None
    finally:
        sys.path.remove(str(folder))


@cache
def unpack_once(path: Path) -> Path:
    """Return an FMU's folder unpacked for this process."""
    folder = Path(tempfile.mkdtemp(prefix="fmu-", dir=process_folder()))
    unpack(path, folder)
    return folder


def _registered_model(name: str) -> tuple[Any, Any, Any] | None:
    from cosim.model.integrate import Stepper
    from cosim.model.namespaces import arrays

    for entry in models().values():
        if f"{entry.model.rpartition(':')[2]}Plant" == name:
            return resolve(entry.model)(), Stepper, arrays()
    return None


class _ModelKind:
    """A model of equations, integrated as in its FMU."""

    def __init__(self, block: FmuBlock, model: Any, stepper: Any, namespace: Any) -> None:
        self.model = model = model.with_values(_changed_defaults(model, block.description))
        self.stepper, self.namespace = stepper, namespace
        self.outputs = tuple(q.name for q in model.outputs)
        catalogue = {kind.name: parameters_of(kind) for kind in model.catalogue}
        self.neutral = {
            f"{name}.{p.name}": p.neutral for name, own in catalogue.items() for p in own if p.neutral is not None
        }

    def fits(self, block: FmuBlock) -> bool:
        """Return whether the FMU has the model's inputs and outputs only. The order of its inputs is stored."""
        names, inputs = [q.name for q in self.model.inputs], [s.name for s in block.inputs]
        if sorted(inputs) != sorted(names) or tuple(s.name for s in block.outputs) != self.outputs:
            return False
        if getattr(self.model, "integrator", "rk4") == "stiff":  # Implicit steps treat a single run only.
            return False
        self.order = [names.index(name) for name in inputs]  # Connected inputs come first.
        return True

    def pattern(self, values: Values) -> Hashable:
        """Return active effects and non-numeric values as a key."""
        awake = (
            name.partition(".")[0] for name, neutral in self.neutral.items() if values.get(name, neutral) != neutral
        )
        return frozenset(awake), tuple(sorted((n, v) for n, v in values.items() if isinstance(v, (bool, str))))

    def make(self, values: Values, count: int, *, compiled: bool) -> Twin:
        return _ModelTwin(self, values, compiled)


def _changed_defaults(model: Any, description: Any) -> dict[str, Any]:
    """Return the FMU's parameter defaults that differ from the model's."""
    present = {e.name: e for e in model.effects}
    values: dict[str, Any] = {}
    for variable in description.modelVariables:
        declared = model.declared.get(variable.name)
        if declared is None or variable.causality != "parameter" or variable.start is None:
            continue
        effect, _, name = variable.name.rpartition(".")
        owner = present.get(effect) if effect else model
        own = getattr(owner, name, declared.default)
        start = variable.start == "true" if isinstance(own, bool) else float(variable.start)
        if start != own:
            values[variable.name] = start
    return values


class _ModelTwin:
    def __init__(self, kind: _ModelKind, values: Values, compiled: bool) -> None:
        self.kind, self.to_compile = kind, compiled
        names = {q.name for q in kind.model.inputs}
        self.starts = {n.removesuffix("_start"): v for n, v in values.items() if n.endswith("_start")}
        self.commands = {n: v for n, v in values.items() if n in names}
        parameters = {n: v for n, v in values.items() if not n.endswith("_start") and n not in names}
        self.model = kind.model.with_values(parameters)
        self.stepper = kind.stepper(self.model, kind.namespace)

    def begin(self, inputs: Array, outputs: Array, t: float) -> None:
        order = self.kind.order
        self.inputs, self.outputs = inputs, outputs
        for place, k in enumerate(order):
            name = self.model.inputs[k].name
            inputs[place] = self.commands.get(name, self.model.start_command()[k])
        self.command = tuple(inputs[order.index(k)] for k in range(len(order)))
        moment = self.stepper.start(t, self.starts)
        self.state = np.empty((len(moment.state), inputs.shape[1]))
        _fill(self.state, moment.state)
        self.t, self.memory = t, moment.memory
        self.sorted = None if order == sorted(order) else np.argsort(order)
        self.compiled = compile_model(self.model, inputs.shape[1]) if self.to_compile else None

    def settle(self) -> None:
        values = self.stepper.output(self.t, tuple(self.state), self.command)
        _fill(self.outputs, values)

    def advance(self, t: float, h: float) -> None:
        # The memory refers to commands, whose rows change.
        command = tuple(row.copy() for row in self.command) if self.memory else self.command
        if self.compiled is None:
            moment = self.stepper.start(t, {})
            after = self.stepper.step(type(moment)(t, tuple(self.state), self.memory), command, h)
            _fill(self.state, after.state)
            self.memory, self.t = after.memory, after.t
            self.settle()
            return
        n = self.compiled.substeps(h)
        dt = h / n
        if not self.memory:
            self.compiled.step(t, dt, n, self.state, self._in_order(), self.outputs)
        else:  # Command shaping acts in every substep.
            acting = np.empty(self.inputs.shape)
            for k in range(n):
                shaped, self.memory = self.stepper.shape(t + k * dt, dt, command, self.memory)
                _fill(acting, shaped)
                self.compiled.step(t + k * dt, dt, 1, self.state, acting, None)
            self.compiled.output(t + h, self.state, self._in_order(), self.outputs)
        self.t = t + h

    def _in_order(self) -> Array:
        """Return the inputs in the model's order."""
        return self.inputs if self.sorted is None else np.ascontiguousarray(self.inputs[self.sorted])


def _fill(rows: Array, values: Sequence[Any]) -> None:
    """Write a number or an array to each row."""
    for row, value in zip(rows, values, strict=True):
        row[:] = value


def merge_values(runs: Sequence[Values]) -> dict[str, Any]:
    """Return values of several runs as numbers or arrays."""
    columns = {name: [values[name] for values in runs] for name in runs[0]}
    return {
        name: column[0]
        if isinstance(column[0], (str, bool)) or all(v == column[0] for v in column)
        else np.array(column, dtype=float)
        for name, column in columns.items()
    }
