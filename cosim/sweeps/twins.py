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
from cosim.blocks.sources import Source
from cosim.model.quantities import parameters_of
from cosim.storage.archive import unpack
from cosim.sweeps.c_lanes import stepping

Given = Mapping[str, Any]  # variable → value, or an array over the runs


class Twin(Protocol):
    """A component as seen by the stepping loop; `inputs` and `outputs` are views of its rows, shape (signals, runs)."""

    def begin(self, inputs: Array, outputs: Array, t: float) -> None:
        """Set the views and the start values of unconnected inputs."""

    def settle(self) -> None:
        """Compute the outputs of initialization from the inputs."""

    def advance(self, t: float, h: float) -> None:
        """Step from `t` to `t + h` [s] and write the outputs."""


class Kind(Protocol):
    """A maker of twins for a component."""

    def pattern(self, given: Given) -> Hashable:
        """Return a key; runs with equal keys are made together."""

    def make(self, given: Given, count: int, *, compiled: bool) -> Twin:
        """Return a twin of `count` runs, compiled if possible."""


def kind_of(component: Component) -> Kind | None:
    """Return the maker of twins for a component, if any."""
    if isinstance(component, Source):
        return _SourceKind(component)
    if not isinstance(component, FmuBlock) or component.exact_inputs or component.exact_outputs:
        return None
    if (twin := twin_of(component.description.modelName)) is not None:
        found = twin()
        return found if found.fits(component) else None
    if (model := model_of(component.path, component.description.modelName)) is not None:
        kind = _ModelKind(component, *model)
        return kind if kind.fits(component) else None
    return None


# -- sources -----------------------------------------------------------------------------------------


class _SourceKind:
    def __init__(self, source: Source) -> None:
        self.source = source

    def pattern(self, given: Given) -> Hashable:
        return ()

    def make(self, given: Given, count: int, *, compiled: bool) -> Twin:
        return _SourceTwin(self.source)


class _SourceTwin:
    """A source with equal values in every run."""

    def __init__(self, source: Source) -> None:
        self.functions = source.functions

    def begin(self, inputs: Array, outputs: Array, t: float) -> None:
        self.outputs, self.t = outputs, t

    def settle(self) -> None:
        for row, function in zip(self.outputs, self.functions, strict=True):
            row[:] = function(self.t)

    def advance(self, t: float, h: float) -> None:
        self.t = t + h
        self.settle()


# -- models ------------------------------------------------------------------------------------------


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
        return _known_model(name)
    folder = unpacked(path) / "resources"
    package = script.removesuffix("_slave")
    # Earlier releases carried the modelling language as `plant`.
    languages = (name for name in ("cosim.model", "plant") if _holds(folder / package, name))
    language = next(languages, None)
    if language is None:
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


def _holds(package: Path, language: str) -> bool:
    """Return whether an FMU's package carries the modelling language."""
    return (package / language.replace(".", "/") / "integrate.py").is_file()


@cache
def unpacked(path: Path) -> Path:
    """Return the folder of an FMU unpacked for this process."""
    folder = Path(tempfile.mkdtemp(prefix="fmu-", dir=process_folder()))
    unpack(path, folder)
    return folder


def _known_model(name: str) -> tuple[Any, Any, Any] | None:
    from cosim.model.integrate import Stepper
    from cosim.model.namespaces import arrays

    for known in models().values():
        if f"{known.model.rpartition(':')[2]}Plant" == name:
            return resolve(known.model)(), Stepper, arrays()
    return None


class _ModelKind:
    """A model of equations, integrated as in its FMU."""

    def __init__(self, block: FmuBlock, model: Any, stepper: Any, namespace: Any) -> None:
        model = model.with_values(_differing(model, block.description))
        self.block, self.model, self.stepper, self.namespace = block, model, stepper, namespace
        self.outputs = tuple(q.name for q in model.outputs)
        catalogue = {kind.name: parameters_of(kind) for kind in model.catalogue}
        self.neutral = {
            f"{name}.{p.name}": p.neutral for name, own in catalogue.items() for p in own if p.neutral is not None
        }

    def fits(self, block: FmuBlock) -> bool:
        """Return whether the FMU has the model's inputs and outputs only. The order of its inputs is stored."""
        names, given = [q.name for q in self.model.inputs], [s.name for s in block.inputs]
        if sorted(given) != sorted(names) or tuple(s.name for s in block.outputs) != self.outputs:
            return False
        if getattr(self.model, "integrator", "rk4") == "stiff":  # Implicit steps treat a single run only.
            return False
        self.order = [names.index(name) for name in given]  # Connected inputs come first.
        return True

    def pattern(self, given: Given) -> Hashable:
        """Return active effects and non-numeric values as a key."""
        awake = {
            name.partition(".")[0] for name, neutral in self.neutral.items() if given.get(name, neutral) != neutral
        }
        return frozenset(awake), tuple(sorted((n, v) for n, v in given.items() if isinstance(v, (bool, str))))

    def make(self, given: Given, count: int, *, compiled: bool) -> Twin:
        return _ModelTwin(self, given, compiled)


def _differing(model: Any, description: Any) -> dict[str, Any]:
    """Return the FMU's parameter defaults that differ from the model's."""
    present = {e.name: e for e in model.effects}
    found: dict[str, Any] = {}
    for variable in description.modelVariables:
        declared = model.declared.get(variable.name)
        if declared is None or variable.causality != "parameter" or variable.start is None:
            continue
        effect, _, name = variable.name.rpartition(".")
        owner = present.get(effect) if effect else model
        own = getattr(owner, name, declared.default)
        given = variable.start == "true" if isinstance(own, bool) else float(variable.start)
        if given != own:
            found[variable.name] = given
    return found


class _ModelTwin:
    def __init__(self, kind: _ModelKind, given: Given, compiled: bool) -> None:
        self.kind, self.to_compile = kind, compiled
        names = {q.name for q in kind.model.inputs}
        starts = {n.removesuffix("_start"): v for n, v in given.items() if n.endswith("_start")}
        values = {n: v for n, v in given.items() if not n.endswith("_start") and n not in names}
        self.given = {n: v for n, v in given.items() if n in names}
        self.starts = starts
        self.model = kind.model.with_values(values)
        self.stepper = kind.stepper(self.model, kind.namespace)

    def begin(self, inputs: Array, outputs: Array, t: float) -> None:
        order = self.kind.order
        self.inputs, self.outputs = inputs, outputs
        for place, k in enumerate(order):
            name = self.model.inputs[k].name
            inputs[place] = self.given.get(name, self.model.start_command()[k])
        self.command = tuple(inputs[order.index(k)] for k in range(len(order)))
        moment = self.stepper.start(t, self.starts)
        self.state = np.empty((len(moment.state), inputs.shape[1]))
        for row, value in zip(self.state, moment.state, strict=True):
            row[:] = value
        self.t, self.memory = t, moment.memory
        self.sorted = None if order == sorted(order) else np.argsort(order)
        self.compiled = stepping(self.model, inputs.shape[1]) if self.to_compile else None

    def settle(self) -> None:
        values = self.stepper.output(self.t, tuple(self.state), self.command)
        for row, value in zip(self.outputs, values, strict=True):
            row[:] = value

    def advance(self, t: float, h: float) -> None:
        # The memory refers to commands, whose rows change.
        command = tuple(row.copy() for row in self.command) if self.memory else self.command
        if self.compiled is None:
            moment = self._moment(t)
            after = self.stepper.step(moment, command, h)
            for row, value in zip(self.state, after.state, strict=True):
                row[:] = value
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
                for row, value in zip(acting, shaped, strict=True):
                    row[:] = value
                self.compiled.step(t + k * dt, dt, 1, self.state, acting, None)
            self.compiled.output(t + h, self.state, self._in_order(), self.outputs)
        self.t = t + h

    def _in_order(self) -> Array:
        """Return the inputs in the model's order."""
        return self.inputs if self.sorted is None else np.ascontiguousarray(self.inputs[self.sorted])

    def _moment(self, t: float) -> Any:
        moment = self.stepper.start(t, {})
        return type(moment)(t, tuple(self.state), self.memory)


def merged(rows: Sequence[Given]) -> dict[str, Any]:
    """Return values of several runs as numbers or arrays."""
    found: dict[str, Any] = {}
    for name in rows[0]:
        values = [row[name] for row in rows]
        same = all(v == values[0] for v in values)
        found[name] = values[0] if same or isinstance(values[0], (str, bool)) else np.array(values, dtype=float)
    return found
