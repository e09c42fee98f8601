"""`design:` of a scenario: gains from weights, cached by content, for `control` takes a second to import."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from controller.gains import Settings
from cosim.files import atomic_write
from cosim.scenario_file import ScenarioFile

GAINS = tuple(f"k_{i}_{j}" for i in (1, 2) for j in range(1, 6))
FORMAT = 2  # raise when the meaning of a cached design changes


def designed_values(file: ScenarioFile) -> dict[str, dict[str, Any]]:
    """Start values by component that the design gives: gains, estimator and the numbers of the design model.

    A design that fails is one more fault of the file.
    """
    design = file.scenario.design
    if design is None or file.faults:  # a faulty scenario is not run
        return {}
    given = {k: v for k in ("thrust_nominal", "lag", "estimator") if (v := getattr(design, k)) is not None}
    numbers = {n: getattr(Settings(**given), n) for n in ("mass", "izz", "arm", "friction", "lag", "thrust_nominal")}
    cached = _cache_file({"format": FORMAT, "Q": design.Q, "R": design.R, "model": numbers})
    gains = _read(cached)
    if gains is None:
        try:
            gains = _design(design.Q, design.R, given)
        except ValueError as error:
            file.faults.append(file.fault(("design",), f"design: {error}"))
            return {}
        try:
            with atomic_write(cached) as stream:
                json.dump(gains, stream)
        except OSError:
            pass  # a cache that cannot be written only costs time
    return {design.component: {**gains, **given}}


def _design(Q: list[float], R: list[float], given: dict[str, Any]) -> dict[str, float]:
    from controller.synthesis import lqr_gain

    K = lqr_gain(Settings(**given), Q, R)
    return {name: float(K[divmod(k, 5)]) for k, name in enumerate(GAINS)}


def _read(cached: Path) -> dict[str, float] | None:
    """A cached design; None where there is none, or it is not one."""
    try:
        gains = json.loads(cached.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    whole = isinstance(gains, dict) and list(gains) == list(GAINS) and all(isinstance(k, float) for k in gains.values())
    return gains if whole else None


def _cache_file(request: dict[str, Any]) -> Path:
    from cosim.version import __version__

    text = json.dumps({"version": __version__, **request}, sort_keys=True)
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return root / "cosim-hovercraft" / "design" / f"{hashlib.sha256(text.encode()).hexdigest()[:32]}.json"
