"""The frozen verdicts: size of a line, studies that are still to be done, figures with and without near-ties."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.blind import baseline
from tests.blind.harness import ARM, FIELD, LABORATORY

CHANNELS = [f"channel_with_a_name_{k}" for k in range(5)]


def errors(value: float) -> dict[str, dict[str, float]]:
    """Return errors of both sets of logs, as in refine.json."""
    return {logs: dict.fromkeys(CHANNELS, value) for logs in ("estimation", "validation")}


def found(name: str, value: float, **more: Any) -> dict[str, Any]:
    """Return refine.json with a claim and many candidates."""
    claim = {"value": value, "unit": "N", "ci95": [value - 0.1, value + 0.1]}
    candidate = {"names": [name, name, name], "log_likelihood_gain": 1e3 / 3, "score_gain": 1e2 / 3, "parameters": {}}
    return {
        "verdict": "effect_found", "grade": "claimed", "rivals": [], "candidates": [candidate] * 40,
        "effects": [{"name": name, "kind": "effect", "parameters": {"value": claim}}],
        "error": dict.fromkeys(("before", "recalibrated", "after", "nearest"), errors(1 / 3)),
        "noise_floor": dict.fromkeys(CHANNELS, 1 / 3),
    } | more  # fmt: skip


def told(suite: str, seed: int, name: str = "drag") -> dict[str, Any]:
    """Return an answer with one hidden effect."""
    return {
        "half": suite, "seed": seed, "kind": "known", "plant": "cart", "truth": {name: {"value": 1 / 3}},
        "size": "usual", "way": "model_exchange", "disturbance": "small", "sensors": ["bias"] * 20,
        "error_true": dict.fromkeys(CHANNELS, 0.1),
        "recorder": dict.fromkeys("abcdefghijklmnopqrstuvwxyz", 1 / 3),
    }  # fmt: skip


def test_a_line_is_small_enough_for_all_studies_of_some_revisions() -> None:
    line = baseline.line_of(FIELD, told(FIELD, 1), found("drag", 1 / 3))
    studies = sum(count for _, count in baseline.SUITES.values())
    assert studies == 270
    assert len(json.dumps(line)) * studies < 1e6
    assert line["effects"] == [
        {"name": "drag", "parameters": {"value": {"value": 0.333333, "ci95": [0.233333, 0.433333]}}}
    ]
    assert len(line["scores"]) == 5
    assert set(line["error"]) == {"before", "recalibrated", "after", "nearest"}


def test_studies_with_a_line_of_the_revision_are_not_done_again(tmp_path: Path) -> None:
    lines = tmp_path / "lines.jsonl"
    first = {suite: seed for suite, (seed, _) in baseline.SUITES.items()}
    assert len(baseline.missing(lines, "abc+")) == 270
    for suite in (LABORATORY, ARM):
        verdict = {"verdict": "failed"} if suite == ARM else found("drag", 1.0)
        baseline.append(lines, baseline.line_of(suite, told(suite, first[suite]), verdict) | {"revision": "abc+"})
    assert len(baseline.missing(lines, "abc+")) == 268
    assert (ARM, first[ARM]) not in baseline.missing(lines, "abc+")
    assert baseline.missing(lines, "abc+", [ARM])[0] == (ARM, first[ARM] + 1)
    assert len(baseline.missing(lines, "another")) == 270
