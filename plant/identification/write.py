"""Files of both kinds of identification: model file, identify.json and report.html."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from cosim.base.version import __version__
from cosim.storage.files import write_text
from cosim.storage.folders import remove_earlier
from plant.identification.estimates import Estimate, Result
from plant.identification.identified import plain_values

RECORD, REPORT = "identify.json", "report.html"


def write(
    out: Path,
    model: tuple[str, str],
    record: Mapping[str, Any],
    results: Iterable[Result],
    page: Callable[[], str] | None,
    *,
    read: Iterable[Path],
) -> None:
    """Write each file completely or not at all.

    The files of an earlier identification are replaced.

    Args:
        model: Name and text of the model file.
        record: Content of identify.json besides estimates and tests.
        page: Function that returns the report, or None.
        read: Input files, which stay where they are.
    """
    results = list(results)
    whole = {
        "schema_version": 1,
        "version": __version__,
        **record,
        "estimates": {f"{r.test}.{e.name}": plain_values(vars(e)) for r in results for e in r.estimates},
        "tests": {r.test: plain_values({**r.details, "notes": r.notes, "warnings": r.warnings}) for r in results},
    }
    texts = [model, (RECORD, json.dumps(whole, indent=1, ensure_ascii=False, allow_nan=False) + "\n")]
    if page is not None:
        texts.append((REPORT, page()))
    remove_earlier(out, read=read)
    for name, text in texts:
        write_text(out / name, text)


def model_text(
    source: str,
    values: Mapping[str, Any],
    sensors: Mapping[str, Any],
    identified: Mapping[str, Estimate],
    repetitions: str,
) -> str:
    """Return a model.yaml: parameters, sensor errors, and interval, unit and origin of identified numbers.

    Args:
        source: Model from which the file derives.
        repetitions: Word after the number of repetitions, such as `runs`.
    """
    lines = ["schema_version: 1", f"model: {source}", "parameters:" if values else "parameters: {}"]
    lines += [f"  {n}: {str(v).lower() if isinstance(v, bool) else repr(float(v))}" for n, v in values.items()]
    lines += ["sensors:" if sensors else "sensors: {}", *(f"  {n}: {v!r}" for n, v in sensors.items())]
    lines += ["identified:" if identified else "identified: {}"]
    for name, e in identified.items():
        origin = json.dumps(f"{e.origin}; {e.repetitions} {repetitions}", ensure_ascii=False)
        lines += [f"  {name}:", f"    ci95: [{e.low!r}, {e.high!r}]", f"    unit: {json.dumps(e.unit)}"]
        lines += [f"    origin: {origin}"]
    return "\n".join(lines) + "\n"
