"""Logs of a craft analysed: model.yaml, identify.json and a report written."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from cosim.files import atomic_write, check_writable
from cosim.identification.craft import CraftOutcome, read_craft
from cosim.identification.craft_report import page
from cosim.identification.distance import distance
from cosim.identification.noise import noise
from cosim.identification.outcome import plain_values
from cosim.version import __version__
from cosim.yaml_file import YamlFile

FILES = ("model.yaml", "identify.json", "report.html")


def identify_craft(yaml: YamlFile, out: Path, *, report: bool = True) -> CraftOutcome:
    """Leave model.yaml, identify.json and report.html in `out`; raises InputError."""
    craft = read_craft(yaml)
    check_writable(out, FILES, craft.files)
    outcome, file = CraftOutcome(craft), craft.file
    if file.rest is not None:
        outcome.results.append(noise(craft.rest, craft.loaded.model, file.rest.window))
    if file.distance is not None:
        asked = file.distance
        outcome.results.append(distance(craft.runs, craft.loaded, asked.parameter, asked.output, craft.covered))
    for name, text in _texts(outcome):
        with atomic_write(out / name) as stream:
            stream.write(text)
    if report:
        with atomic_write(out / "report.html") as stream:
            stream.write(page(outcome))
    return outcome


def _texts(outcome: CraftOutcome) -> Iterator[tuple[str, str]]:
    loaded = outcome.craft.loaded
    found = {e.name: e for r in outcome.results if r.test == "distance" for e in r.estimates}
    values: Mapping[str, Any] = {**loaded.parameters, **{n: e.value for n, e in found.items()}}
    lines = ["schema_version: 1", f"model: {loaded.source}", "parameters:" if values else "parameters: {}"]
    lines += [f"  {n}: {str(v).lower() if isinstance(v, bool) else repr(float(v))}" for n, v in values.items()]
    lines += ["sensors:" if loaded.sensors else "sensors: {}", *(f"  {n}: {v!r}" for n, v in loaded.sensors.items())]
    lines += ["identified:" if found else "identified: {}"]
    for n, e in found.items():
        lines += [f"  {n}:", f"    ci95: [{e.low!r}, {e.high!r}]", f"    unit: {json.dumps(e.unit)}"]
        lines += [f"    origin: {json.dumps(f'{e.origin}; {e.repetitions} runs', ensure_ascii=False)}"]
    yield "model.yaml", "\n".join(lines) + "\n"
    record = {
        "schema_version": 1,
        "name": outcome.craft.file.name,
        "version": __version__,
        "estimates": {k: plain_values(vars(e)) for k, e in outcome.estimates.items()},
        "tests": {r.test: plain_values({**r.more, "notes": r.notes}) for r in outcome.results},
    }
    yield "identify.json", json.dumps(record, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
