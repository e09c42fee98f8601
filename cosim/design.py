"""`design:` of a scenario: gains from weights, cached by content, for `control` takes a second to import."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from cosim.errors import InputError
from cosim.files import atomic_write
from cosim.scenario_file import ScenarioFile

FORMAT = 1  # raise when the meaning of a cached design changes


def designed_values(file: ScenarioFile) -> dict[str, dict[str, Any]]:
    """Start values by component that the design gives: gains, estimator and the numbers of the design model."""
    design = file.scenario.design
    if design is None or file.faults:  # a faulty scenario is not run
        return {}
    given = {k: v for k in ("thrust_nominal", "lag", "estimator") if (v := getattr(design, k)) is not None}
    request = {"format": FORMAT, "Q": design.Q, "R": design.R, **given}
    cached = _cache_file(request)
    try:
        gains = json.loads(cached.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        gains = _design(file, design.Q, design.R, given)
        try:
            with atomic_write(cached) as stream:
                json.dump(gains, stream)
        except OSError:
            pass  # a cache that cannot be written only costs time
    return {design.component: {**gains, **given}}


def _design(file: ScenarioFile, Q: list[float], R: list[float], given: dict[str, Any]) -> dict[str, float]:
    from controller.gains import Settings
    from controller.synthesis import lqr_gain

    try:
        K = lqr_gain(Settings(**given), Q, R)
    except ValueError as error:
        raise InputError([file.fault(("design",), f"design: {error}")]) from None
    return {f"k_{i + 1}_{j + 1}": float(K[i, j]) for i in range(2) for j in range(5)}


def _cache_file(request: dict[str, Any]) -> Path:
    from cosim.version import __version__

    text = json.dumps({"version": __version__, **request}, sort_keys=True)
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return root / "cosim-hovercraft" / "design" / f"{hashlib.sha256(text.encode()).hexdigest()[:32]}.json"
