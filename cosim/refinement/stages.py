"""How far a refine is: stage k of n, as a user is told."""

from __future__ import annotations

from collections.abc import Sequence

ORDER: Sequence[tuple[str, ...]] = (  # what is told in each stage; one that is over does not come again
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
    ("replaying with the claim and without",),
    ("building the refined FMU",),
    ("replaying through the FMUs",),
    ("measuring the noise floor",),
    ("drawing the report",),
)
_PLACE = {words: number for number, stage in enumerate(ORDER, 1) for words in stage}


def numbered(words: str) -> tuple[int, int]:
    """Return number of the stage in which this is told, 0 where it is told in none, and how many stages there are."""
    return _PLACE.get(words.partition(":")[0], 0), len(ORDER)
