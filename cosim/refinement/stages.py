"""Stages of a refinement, shown as stage k of n."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

STAGE_MESSAGES: Sequence[tuple[str, ...]] = (  # messages of each stage; a finished stage does not return
    ("reading the logs",),
    ("recalibrating the base model",),
    (
        "predicting the gain of every candidate",
        "trying every effect, sensor and parameter",
        "searching for further candidates",
        "removing candidates without effect",
        "finishing the best fits",
        "fitting the rivals of the best",
        "repeating the most probable fits from other start values",
        "predicting without process noise",
    ),
    ("computing posterior probabilities",),
    ("searching for unmodelled dynamics",),
    ("replaying with and without the claim",),
    ("building the refined FMU",),
    ("replaying through the FMUs",),
    ("measuring the noise floor",),
    ("measuring error bands",),
    ("drawing the report",),
)
_PLACE = {words: number for number, stage in enumerate(STAGE_MESSAGES, 1) for words in stage}


def stage_number(words: str) -> tuple[int, int]:
    """Return the number of the stage with a progress message (0 if unknown), and the number of stages."""
    return _PLACE.get(words.partition(":")[0], 0), len(STAGE_MESSAGES)


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
