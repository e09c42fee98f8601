"""JSON schemas of the files that people write, for the completion and the marks of an editor."""

from __future__ import annotations

import re
from typing import Any

from pydantic import BaseModel

from cosim.base.registry import SCHEMAS, resolve

DIALECT = "https://json-schema.org/draft/2020-12/schema"
TITLES = {"scenario": "cosim scenario", "study": "cosim study", "model": "cosim model file", "sweep": "cosim sweep",
          "protocol": "cosim protocol of a testing bench"}  # fmt: skip
KEY = re.compile(r"^\s*`?(\w+)`?:\s+(\S.*)$")


def schema_of(kind: str) -> dict[str, Any]:
    """JSON schema of a `scenario`, `study`, `model`, `sweep` or `protocol`, each key with what it means."""
    schema = _model(kind).model_json_schema(by_alias=True)
    for part in (schema, *schema.get("$defs", {}).values()):
        _described(part)
    limits = schema.get("$defs", {}).get("Limits", {}).get("properties", {})
    for key, content in limits.items():  # 10 s, 2 GB
        limits[key] = {"description": content.get("description", ""), "type": ["number", "string", "null"]}
    return {"$schema": DIALECT, **_switched(schema), "title": TITLES[kind]}


def _model(kind: str) -> type[BaseModel]:
    if kind in SCHEMAS:
        found: type[BaseModel] = resolve(SCHEMAS[kind])
        return found
    if kind == "scenario":
        from cosim.scenario.scenario import Scenario

        return Scenario
    if kind == "sweep":
        from cosim.sweeps.sweep_file import SweepFile

        return SweepFile
    if kind == "study":
        from cosim.refinement.study import StudyFile

        return StudyFile
    from cosim.loading.file import ModelFile

    return ModelFile


def _described(part: dict[str, Any]) -> None:
    """Move what a docstring says of each key, `key: meaning`, to the key."""
    keys: dict[str, Any] = part.get("properties", {})
    kept, last = [], ""
    for line in str(part.get("description", "")).splitlines():
        found = KEY.match(line)
        if found and found[1] in keys:
            last = found[1]
            keys[last]["description"] = found[2]
        elif last and line.strip():
            keys[last]["description"] += f" {line.strip()}"
        elif not last:
            kept.append(line)
    if kept:
        part["description"] = "\n".join(kept).strip()


def _switched(node: Any) -> Any:
    """With `on` and `off`, as in YAML 1.1, wherever true and false may stand."""
    if isinstance(node, list):
        return [_switched(value) for value in node]
    if not isinstance(node, dict):
        return node
    inner = {key: _switched(value) for key, value in node.items()}
    if inner.get("type") != "boolean":
        return inner
    return {**{k: v for k, v in inner.items() if k != "type"}, "anyOf": [{"type": "boolean"}, {"enum": ["on", "off"]}]}
