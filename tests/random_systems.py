"""Random systems of FMUs and blocks, with steps of their own, noise and faults on their connections."""

from __future__ import annotations

import json
from pathlib import Path
from random import Random
from typing import Any

from tests.coupled import LINEAR, coupled_fmu
from tests.instants import CONSTANT, instants_fmu
from tests.walker import walker_fmu

STEP = 0.01
FAULTS: tuple[dict[str, Any], ...] = (
    {"kind": "delay", "delay": 0.03},
    {"kind": "dropout", "probability": 0.4},
    {"kind": "freeze", "from": 0.1, "to": 0.3},
    {"kind": "bias", "value": 0.25, "from": 0.2},
    {"kind": "scale", "value": -0.5},
    {"kind": "spike", "value": 2.0, "probability": 0.1},
    {"kind": "stuck", "value": 0.3, "from": 0.25, "to": 0.31},
)


def build_fmus(folder: Path) -> None:
    """Build the FMUs of random systems."""
    for version in ("2", "3"):
        walker_fmu(folder / f"saving{version}.fmu", saves=True, version=version)
    walker_fmu(folder / "direct2.fmu", saves=False)
    walker_fmu(folder / "text.fmu", saves=True, mood=True)
    instants_fmu(folder / "clocked.fmu", CONSTANT)
    coupled_fmu(folder / "linear.fmu", LINEAR, slopes=True)
    rows = "".join(f"{k / 7},{(k * k) % 11},{k % 3}\n" for k in range(40))
    (folder / "recording.csv").write_text(f"time,w,v\n{rows}")


def random_system(random: Random) -> dict[str, Any]:
    """Return the scenario of a random system; FMUs with direct feedthrough follow each other in one direction."""
    names = [f"c{k}" for k in range(random.randint(2, 5))]
    kinds = [random.choice(("saving2", "saving3", "direct2")) for _ in names]
    components: dict[str, Any] = {
        name: {"fmu": f"{kind}.fmu", "start": {"gain": round(random.uniform(0.2, 1.5), 3)}}
        for name, kind in zip(names, kinds, strict=True)
    }
    for name in names:
        if random.random() < 0.3:
            components[name]["step"] = random.choice((1, 2, 3, 4)) * STEP
    components["known"] = {
        "block": "reference",
        "signals": {"r": {"start": 0, "changes": [{"at": 0.105, "to": 1}, {"at": 0.2, "to": 0, "rate": 2}]}},
    }
    components["recorded"] = {"block": "playback", "file": "recording.csv"}
    connections: list[dict[str, Any]] = []
    for k, (name, kind) in enumerate(zip(names, kinds, strict=True)):
        others = names[:k] if kind == "direct2" else [other for other in names if other != name]
        source = random.choice([f"{other}.y" for other in others] + ["known.r", "recorded.w", "recorded.v"])
        connections.append({"from": source, "to": f"{name}.u"})
        if random.random() < 0.4:
            connections[-1]["noise"] = {"variance": 0.01, "bias": round(random.uniform(-0.1, 0.1), 3)}
        if random.random() < 0.2:
            connections[-1]["factor"] = round(random.uniform(-2, 2), 3)
    targets = [f"{name}.u" for name in names if "step" not in components[name]]
    faults = random.sample(FAULTS, random.randint(0, 3)) if targets else []
    return {
        "name": "random",
        "duration": 0.48,
        "step": STEP,
        "seed": random.randint(1, 1000),
        "algorithm": random.choice(("gauss-seidel", "gauss-seidel", "jacobi")),
        "components": components,
        "connections": connections,
        "faults": [{"on": random.choice(targets), **fault} for fault in faults],
        "events": [
            {"at": round(random.uniform(0.0, 0.48), 3), "set": {f"{random.choice(names)}.gain": 0.7}}
            for _ in range(random.randint(0, 2))
        ],
    }


def with_component(system: dict[str, Any], **component: Any) -> dict[str, Any]:
    """Return a system with a further component without connections."""
    return system | {"components": system["components"] | {"aside": component}}


def write(system: dict[str, Any], path: Path) -> Path:
    """Write a system as a scenario."""
    path.write_text(json.dumps(system))
    return path
