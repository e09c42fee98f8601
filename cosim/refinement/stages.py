"""Stages of a refinement, shown as stage k of n."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

ORDER: Sequence[tuple[str, ...]] = (  # progress messages of each stage, in order
    ("reading the logs",),
    ("recalibrating the base model",),
    (
        "asking what every candidate promises",
        "trying every effect, sensor and parameter",
        "looking for what is missing beside",
        "leaving out what does nothing",
        "fitting the best to the end",
        "fitting the best further",
        "replacing each part",
        "fitting what comes near the best",
        "predicting with the equations trusted",
    ),
    ("weighing what was found",),
    ("looking for what has no name",),
    ("fitting predictions over the horizon", "replaying with the claim and without"),
    ("building the refined FMU",),
    ("replaying through the FMUs",),
    ("measuring the noise floor",),
    ("drawing the report",),
)
_PLACE = {words: number for number, stage in enumerate(ORDER, 1) for words in stage}


def stage_number(words: str) -> tuple[int, int]:
    """Return the number of the stage with a progress message (0 if unknown), and the number of stages."""
    return _PLACE.get(words.partition(":")[0], 0), len(ORDER)


class Watcher:
    """Base class of progress functions that also receive all hypotheses fitted so far."""

    def __call__(self, stage: str, share: float) -> None:
        """Receive the current stage and its completed share (0 … 1)."""

    def ranking(self, hypotheses: Sequence[Any]) -> None:
        """Receive all hypotheses fitted so far."""


def report_ranking(progress: Callable[[str, float], None], hypotheses: Sequence[Any]) -> None:
    """Pass all hypotheses fitted so far to a progress function that is a `Watcher`."""
    if isinstance(progress, Watcher):
        progress.ranking(hypotheses)
