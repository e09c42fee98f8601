"""`cosim list` shows the values of criteria and sorts by them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import cosim
from cosim.core.errors import InputError
from cosim.verbs.results import list_command
from tests.test_first_steps import told


def _listed(*words: str) -> list[dict[str, object]]:
    found: list[dict[str, object]] = json.loads(told("list", "--json", *words))["results"]
    return found


def test_runs_are_sorted_by_a_criterion_and_missed_ones_first_by_outcome(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for value in (3.0, 1.0, 2.0):
        cosim.run(
            {
                "name": "step",
                "duration": 1,
                "step": 1,
                "components": {"r": {"block": "reference", "signals": {"y": {"start": value}}}},
                "criteria": {"peak": {"of": "r.y", "max": 2.5}},
            },
            f"results/step{value:g}",
        )
    assert [entry["number"] for entry in _listed()] == [1, 2, 3]
    assert [entry["number"] for entry in _listed("--sort", "peak of r.y")] == [2, 3, 1]
    assert _listed("--sort", "outcome")[0]["number"] == 1
    values = [entry["criteria"][0]["value"] for entry in _listed("--sort", "name")]  # type: ignore[index]
    assert values == [1.0, 2.0, 3.0]
    with pytest.raises(InputError) as error:
        list_command(sort="peek")
    assert error.value.exit_code == 2
