"""`cosim schema`: JSON schemas of hand-written files, for editors, and of results."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.core.errors import InputError
from cosim.core.registry import resolve
from cosim.files.artefact import artefacts
from cosim.verbs.cli import say_json

if TYPE_CHECKING:
    from pydantic import BaseModel

DIALECT = "https://json-schema.org/draft/2020-12/schema"
RESULTS = {  # kind of result → class of its content
    "refine_result": "cosim.refinement.record:Record",
    "fit_result": "cosim.calibration.fit_record:Record",
}
KEY = re.compile(r"^\s*`?(\w+)`?:\s+(\S.*)$")


def command(kind: str) -> None:
    """Print the JSON schema of a kind of file, for editors.

    Args:
        kind: Kind of file: scenario, study, model, refine_result, …, or one of a package.

    Example: cosim schema scenario
    """
    say_json(schema_of(kind))


def schema_of(name: str) -> dict[str, Any]:
    """Return the JSON schema of a kind of file, each key with its meaning; raise InputError for an unknown kind."""
    kinds = {a.schema_name: a for a in artefacts() if a.schema}
    places = {**{kind: a.schema for kind, a in kinds.items()}, **RESULTS}
    if name not in places:
        raise InputError.at(
            Path(name), f"is no kind of file that has a schema; give one of {', '.join(sorted(places))}"
        )
    model: type[BaseModel] = resolve(places[name])
    schema = model.model_json_schema(mode="serialization" if name in RESULTS else "validation")
    for part in (schema, *schema.get("$defs", {}).values()):
        keys: dict[str, Any] = part.get("properties", {})
        rest, last = [], ""
        for line in str(part.get("description", "")).splitlines():  # `key: meaning` goes to the key
            match = KEY.match(line)
            if match and match[1] in keys:
                last = match[1]
                keys[last]["description"] = match[2]
            elif last and line.strip():
                keys[last]["description"] += f" {line.strip()}"
            elif not last:
                rest.append(line)
        if rest:
            part["description"] = "\n".join(rest).strip()
        for content in keys.values() if name in RESULTS else ():
            content.pop("title", None)  # repeats the key
    if name in RESULTS:
        return {"$schema": DIALECT, **schema}
    limits = schema.get("$defs", {}).get("Limits", {}).get("properties", {})
    for key, content in limits.items():  # 10 s, 2 GB
        limits[key] = {"description": content.get("description", ""), "type": ["number", "string", "null"]}
    return {"$schema": DIALECT, **_allow_on_and_off(schema), "title": kinds[name].title}


def _allow_on_and_off(node: Any) -> Any:
    """Allow `on` and `off`, as in YAML 1.1, in place of true and false."""
    if isinstance(node, list):
        return [_allow_on_and_off(value) for value in node]
    if not isinstance(node, dict):
        return node
    inner = {key: _allow_on_and_off(value) for key, value in node.items()}
    if inner.get("type") != "boolean":
        return inner
    return {**{k: v for k, v in inner.items() if k != "type"}, "anyOf": [{"type": "boolean"}, {"enum": ["on", "off"]}]}
