"""MCAP: a topic per component with a JSON message per row, as PlotJuggler shows. Needs mcap (extra `mcap`)."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Container, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.drafts import draft_of
from cosim.base.errors import Fault, InputError
from cosim.base.extras import optional
from cosim.storage.table_source import Frame, Source, SourceColumn, as_text

MAGIC = b"\x89MCAP0\r\n"
NANO = 1e9
LARGEST_TIME = 2**63 / NANO  # [s]
SIGNAL_TIME = "time (signal)"  # key of a variable that is called as the time of each message is


class Mcap(Source):
    """MCAP with JSON messages.

    A message of topic `/component` has its variables and `time` [s], whose double is exact; the log time is rounded to
    nanoseconds. The schema of the topic has the unit of every variable.
    """

    name = "MCAP"
    suffixes = (".mcap",)
    magic = MAGIC
    writes = True

    def frame(self, path: Path, names: Container[str] = (), text: Collection[str] = ()) -> Frame:
        """Read the topics with JSON messages; rows are the different times of all messages."""
        reader = optional("mcap.reader", lambda message: Fault(path, 0, 0, message))
        signals: dict[str, dict[float, Any]] = {}
        units: dict[str, str] = {}
        types: dict[str, str] = {}
        properties: dict[int, dict[str, Any]] = {}
        try:
            with path.open("rb") as stream:
                for schema, channel, message in reader.make_reader(stream).iter_messages():
                    if channel.message_encoding != "json":
                        continue
                    content = json.loads(message.data)
                    if not isinstance(content, dict):
                        raise ValueError(f"a message of {channel.topic} is no object")
                    t = float(content.pop("time", message.log_time / NANO))
                    if channel.id not in properties:
                        properties[channel.id] = _properties(schema)
                    topic = channel.topic.strip("/").replace("/", ".")
                    for name, value in _flat(content):
                        full = f"{topic}.{'time' if name == SIGNAL_TIME else name}".removeprefix(".")
                        if t in signals.setdefault(full, {}):
                            raise ValueError(f"two messages of {channel.topic} have the time {t} s")
                        signals[full][t] = value
                        about = properties[channel.id].get(name, {})
                        units.setdefault(full, about.get("unit", ""))
                        types.setdefault(full, about.get("type", ""))
        except Exception as error:  # mcap reports damage by errors of its own and of struct
            raise InputError.at(path, f"is no MCAP file that can be read: {str(error)[:200]}; write it again") from None
        times = sorted({t for values in signals.values() for t in values})
        columns = [SourceColumn("time", "s", np.array(times, dtype=np.float64))]
        for name, by_time in signals.items():
            values = _values(by_time, times, is_text=name in text)
            columns.append(SourceColumn(name, units[name], values, is_text=types[name] == "string"))
        return Frame(columns if times else (), range(1, len(times) + 1))

    def check_writable(self) -> None:
        """Raise InputError if mcap is not installed."""
        optional("mcap", "--format mcap")

    def write(self, path: Path, columns: Sequence[SourceColumn]) -> None:
        """Write a message per component and row.

        Raises:
            InputError: A time is negative, which MCAP cannot hold, or too large.
        """
        writer = optional("mcap.writer", "--format mcap")
        time, *others = columns
        times = np.asarray(time.values, dtype=np.float64)
        if times.size and not (times.min() >= 0.0 and times.max() < LARGEST_TIME):
            raise InputError.at(
                path,
                (
                    f"times from {float(times.min()):g} s to {float(times.max()):g} s: MCAP counts from 0; take "
                    "another format"
                ),
            )
        topics: dict[str, list[tuple[str, str, Sequence[Any]]]] = {}
        for column in others:
            component, _, variable = column.name.partition(".")
            values = column.values
            cells = values.tolist() if isinstance(values, np.ndarray) else [_cell(v) for v in values]
            key = SIGNAL_TIME if variable == "time" else variable or component
            topics.setdefault(component, []).append((key, column.unit, cells))
        with draft_of(path) as draft, draft.open("wb") as stream:
            file = writer.Writer(stream)
            file.start(profile="", library="cosim")
            channels = []
            for component, variables in topics.items():
                properties = {"time": {"type": "number", "unit": "s"}}
                properties |= {name: {"unit": unit, "type": _type(cells)} for name, unit, cells in variables}
                schema = json.dumps({"type": "object", "properties": properties}).encode()
                number = file.register_schema(name=component, encoding="jsonschema", data=schema)
                channels.append(file.register_channel(f"/{component}", "json", number))
            for row, t in enumerate(times.tolist()):
                stamp = round(t * NANO)
                for channel, variables in zip(channels, topics.values(), strict=True):
                    content = {"time": t, **{name: _number(cells[row]) for name, _, cells in variables}}
                    file.add_message(channel, stamp, json.dumps(content).encode(), stamp)
            file.finish()


MCAP = Mcap()


def _properties(schema: Any) -> dict[str, Any]:
    """Return name → description of the variables of a JSON schema."""
    content: dict[str, Any] = json.loads(schema.data) if schema is not None and schema.data else {}
    properties: dict[str, Any] = content.get("properties", {})
    return properties


def _flat(content: dict[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield names and values of a message, `a.b` of an object in it and `a[0]` of a list."""
    for name, value in content.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{before}{name}.")
        elif isinstance(value, list):
            yield from _flat({f"{name}[{k}]": item for k, item in enumerate(value)}, before)
        else:
            yield f"{before}{name}", value


def _cell(value: Any) -> Any:
    return value if isinstance(value, int) else as_text(value)


def _type(cells: Sequence[Any]) -> str:
    first = cells[0] if cells else 0.0
    return "string" if isinstance(first, str) else "integer" if isinstance(first, int) else "number"


def _number(value: Any) -> Any:
    """Return a value as JSON has it: infinite numbers as text, missing ones as null."""
    if not isinstance(value, float) or math.isfinite(value):
        return value
    return None if math.isnan(value) else str(value)


def _values(by_time: dict[float, Any], times: Sequence[float], *, is_text: bool) -> Any:
    """Return the values at all times: numbers, NaN if missing, or a list of texts."""
    values = [by_time.get(t) for t in times]
    if is_text or any(isinstance(v, str) and v not in {"inf", "-inf"} for v in values):
        return ["" if v is None else str(v) for v in values]
    if all(isinstance(v, int) and abs(v) < 2**63 for v in values):
        return np.array(values, dtype=np.int64)
    return np.array([math.nan if v is None else float(v) for v in values], dtype=np.float64)
