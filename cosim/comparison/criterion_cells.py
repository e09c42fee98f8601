"""Outcomes of criteria as cells of a table with a column for each run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from cosim.base.text import amount


def criterion_limit(entry: Mapping[str, Any]) -> str:
    """Return the limit of a criterion as text."""
    return amount(float(entry.get("max", math.nan)), str(entry.get("unit") or ""))


def criterion_cell(entry: Mapping[str, Any] | None, *, limit: bool = True) -> tuple[str, str]:
    """Return the value as text, with its limit, and the tone of the outcome.

    The tone is good, bad, or "" for a run without the criterion.
    """
    if entry is None:
        return "not asked", ""
    value = entry.get("value")
    text = "never" if value is None else amount(float(value), str(entry.get("unit") or ""))
    return f"{text} of {criterion_limit(entry)}" if limit else text, "good" if entry.get("met") else "bad"


def tone_of(*, judged: bool, same: bool) -> str:
    """Return the tone of a verdict on a page."""
    return "plain" if not judged else "good" if same else "bad"
