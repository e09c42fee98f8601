"""Live page of a refinement: its stages and the ranking of hypotheses so far."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cosim.live.live_page import LivePage
from cosim.refinement.stages import ORDER, Ranked, Watcher, stage_number

MAX_RANKED = 12  # hypotheses on the page


class LiveRefine(LivePage, Watcher):
    """A watcher of a refinement that shows it on a page, and hands progress on to the terminal."""

    activity = "refinement"

    def __init__(self, title: str, port: int = 0, progress: Any = None) -> None:
        self._progress = progress
        self._number, self._words, self._share = 0, "", 0.0
        self._times: list[float] = []  # begin of each stage [s]
        self._ranking: list[dict[str, Any]] = []
        self._fitted = 0
        super().__init__(title, port)

    def __call__(self, stage: str, share: float) -> None:
        """Show the current stage and its finished share."""
        if self._progress is not None:
            self._progress(stage, share)
        with self._lock:
            number, _ = stage_number(stage)
            while len(self._times) < number:
                self._times.append(time.monotonic())
            self._number, self._words, self._share = max(number, self._number), stage, share
        self.update(phase="running")

    def ranking(self, hypotheses: Sequence[Ranked]) -> None:
        """Show the best hypotheses so far."""
        base = next((h.score for h in hypotheses if not h.names), None)
        best = sorted(hypotheses, key=lambda h: h.score)[:MAX_RANKED]
        self._fitted = len(hypotheses)
        self._ranking = [{"names": list(h.names), "gain": None if base is None else base - h.score} for h in best]
        self.update()

    def show_verdict(self, record: Mapping[str, Any], report: Path) -> None:
        """Show the sentence of the verdict and the report."""
        self.report = report
        self.update(message=str(record["sentence"]))

    def state(self) -> dict[str, Any]:
        """Return the whole state."""
        state = super().state()
        with self._lock:
            end = self._begin + state["elapsed"]
            times = [*self._times, end]
            done = len(ORDER) if state["phase"] == "finished" else self._number - 1
            stages = [
                {
                    "words": words[0],
                    "state": "done" if k < done else "now" if k == done and not self.has_ended else "waiting",
                    "seconds": times[k + 1] - times[k] if k < len(self._times) else None,
                }
                for k, words in enumerate(ORDER)
            ]
            return {
                **state,
                "stages": stages,
                "words": self._words,
                "share": self._share,
                "done": max(0, done),
                "total": len(ORDER),
                "ranking": self._ranking,
                "fitted": self._fitted,
            }
