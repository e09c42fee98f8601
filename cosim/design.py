"""`design:` of a scenario: gains from weights, cached by content, for `control` takes a second to import."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

from controller.gains import Settings
from cosim.errors import InputError
from cosim.files import atomic_write
from cosim.scenario import Design
from cosim.scenario_file import ScenarioFile
from plant.hovercraft import Hovercraft
from plant.quantities import parameters_of

GAINS = tuple(f"k_{i}_{j}" for i in (1, 2) for j in range(1, 6))
FORMAT = 3  # raise when the meaning of a cached design changes


def designed_values(file: ScenarioFile) -> dict[str, dict[str, Any]]:
    """Start values by component that the design gives: gains, estimator and the numbers of the design model.

    A design that fails is one more fault of the file.
    """
    design = file.scenario.design
    if design is None or file.faults:  # a faulty scenario is not run
        return {}
    given = {k: v for k in ("thrust_nominal", "lag", "estimator") if (v := getattr(design, k)) is not None}
    try:
        craft = _craft(file, design.model)
    except InputError as error:
        file.faults += error.faults
        return {}
    cached = _cache_file({"design": design.model_dump(exclude={"component", "model"}), "craft": _content(craft)})
    values = _read(cached)
    if values is None:
        try:
            values = _design(design, craft, given)
        except ValueError as error:
            file.faults.append(file.fault(("design",), f"design: {error}"))
            return {}
        try:
            with atomic_write(cached) as stream:
                json.dump(values, stream)
        except OSError:
            pass  # a cache that cannot be written only costs time
    return {design.component: {**values, **given}}


def _craft(file: ScenarioFile, model: str | None) -> Hovercraft | None:
    """The craft of `design.model`; None where none is named."""
    if model is None:
        return None
    from cosim.refine.model_file import load_model

    craft = load_model(model, file.path.parent).model
    if not isinstance(craft, Hovercraft):
        message = f"{model} is no hovercraft; the controller that is designed here flies nothing else"
        raise InputError([file.fault(("design", "model"), message)])
    return craft


def _content(craft: Hovercraft | None) -> dict[str, Any]:
    """What a design depends on beside the scenario's own keys: the craft's numbers, or the controller's."""
    if craft is None:
        return {p.name: getattr(Settings(), p.name) for p in parameters_of(Settings)}
    owners = {"": craft} | {f"{e.name}.": e for e in craft.awake}
    return {prefix + p.name: getattr(owner, p.name) for prefix, owner in owners.items() for p in parameters_of(owner)}


def _design(design: Design, craft: Hovercraft | None, given: dict[str, Any]) -> dict[str, float]:
    """Gains, and the craft's numbers where there is one."""
    from controller.synthesis import lqr_gain, numbers_of

    numbers = {} if craft is None else numbers_of(craft)
    K = lqr_gain(replace(Settings(), **{**numbers, **given}), design.Q, design.R)
    return {name: float(K[divmod(k, 5)]) for k, name in enumerate(GAINS)} | numbers


def _read(cached: Path) -> dict[str, float] | None:
    """A cached design; None where there is none, or it is not one."""
    try:
        values = json.loads(cached.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    whole = isinstance(values, dict) and set(GAINS) <= values.keys() and all(type(v) is float for v in values.values())
    return values if whole else None


def _cache_file(request: dict[str, Any]) -> Path:
    from cosim.version import __version__

    text = json.dumps({"version": __version__, "format": FORMAT, **request}, sort_keys=True)
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return root / "cosim-hovercraft" / "design" / f"{hashlib.sha256(text.encode()).hexdigest()[:32]}.json"
