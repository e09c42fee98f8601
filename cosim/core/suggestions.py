"""Suggestions of a close word for one that is unknown."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from itertools import islice

WORDS, LONGEST_WORD = 2000, 100  # searched words, and their length


def closest(word: str, words: Iterable[str], similarity: float = 0.6) -> str:
    """Return the closest of some words, or "".

    Args:
        similarity: Required similarity; 1 means equal.
    """
    if len(word) > LONGEST_WORD:
        return ""
    candidates = [w for w in islice(words, WORDS) if len(w) <= LONGEST_WORD]
    return "".join(difflib.get_close_matches(word, candidates, n=1, cutoff=similarity))


def did_you_mean(word: str, words: Iterable[str]) -> str:
    """Return `; did you mean "…"?` for a close word, or ""."""
    match = closest(word, words)
    return f'; did you mean "{match}"?' if match else ""
