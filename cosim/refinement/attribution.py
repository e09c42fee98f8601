"""Which effect is missing: fit every hypothesis with process noise free, compare, claim or abstain.

The base fit first; then every candidate alone; then the best one with every other, and the best few in pairs, for one
of two missing effects alone can fit with the wrong sign. A hypothesis is scored by its objective + ½·k·ln N (half of
BIC). What is left is then tried against terms of no catalogue (`unnamed`): where one of them is significant, the
catalogue does not hold the answer.
"""

from __future__ import annotations

from collections.abc import Sequence

from cosim.refinement.candidates import Candidate
from cosim.refinement.held_out import held_out_gain
from cosim.refinement.hypotheses import Attribution, Hypothesis
from cosim.refinement.judgement import (
    SIGNIFICANT,
    SIGNIFICANT_IN_NOISE,
    Contest,
    is_noisy,
    noise_gain,
    significant,
    strained,
)
from cosim.refinement.problem import Problem, coarsened
from cosim.refinement.search import Parts, Progress, Search
from cosim.refinement.sensor_noise import at_rest
from plant.model import Model

CLAIM = 6.0  # score a hypothesis must gain on the one it extends
CLAIM_IN_NOISE = 15.0  # the same where process noise is at work: it is seldom as white as the filter takes it to be
SHARE = 0.02  # of what the first effects gain, that one more must gain too
NEAR = 15.0  # score within which a hypothesis is fitted to the end before it is decided
TO_THE_END = 60  # iterations, within which every fit met so far has converged
MOST_EFFECTS = 3
PAIRS_AMONG = 4


class Attributor:
    """The order of the steps: base, single candidates, extensions, the best to the end."""

    def __init__(
        self,
        model: Model,
        problem: Problem,
        candidates: Sequence[Candidate],
        progress: Progress = lambda stage, share: None,
    ) -> None:
        self.candidates, self.progress = candidates, progress
        self.fine = problem
        self.search = Search(model, coarsened(problem), progress)
        self.drowned: set[tuple[str, ...]] = set()
        self.claim = CLAIM

    def run(self) -> Attribution:
        """Base fit, singles, extensions, rivals."""
        search = self.search
        self.progress("recalibrating the base model", 0.0)
        base = search.hypothesis((), None)
        search.reached = base.fit.objective
        self.claim = CLAIM_IN_NOISE if is_noisy(search.problem, base.fit) else CLAIM
        alone = [(c,) for c in self.candidates]
        singles = search.fit_all(alone, base, "trying every effect, sensor and parameter", self.claim)
        best = self._better(singles, base, self.claim, final=False)
        if best is not base:
            best = self._extended(best, singles, base)
        self.progress("fitting the best to the end", 0.0)
        search.problem = self.fine
        base, best = self._decided(base, best)
        ranking = tuple(sorted(search.tried.values(), key=lambda h: h.score))
        contest = Contest(base, best, ranking, self.claim, search.problem.values, self.drowned)
        return Attribution(
            base,
            ranking,
            best,
            contest.rivals(),
            held_out_gain(search, best, base),
            noise_gain(search.problem, best.fit),
            contest.reasons(),
            self._hidden(nothing_claimed=best is base),
        )

    def _extended(self, best: Hypothesis, singles: Sequence[Hypothesis], base: Hypothesis) -> Hypothesis:
        """Candidates added while one gains enough; pairs of the best few singles compete with the first extension."""
        promising = [h for h in sorted(singles, key=lambda h: h.score) if base.score - h.score > self.claim]
        top = [h.candidates[0] for h in promising[:PAIRS_AMONG]]
        while len(best.candidates) < MOST_EFFECTS:
            # under a coloured disturbance a small second effect is soon imagined: it must be worth some of the first
            gain = self.claim + SHARE * (base.score - best.score)
            stage = f"looking for what is missing beside {' and '.join(best.names)}"
            options = self.search.fit_all(self._extensions(best, top), best, stage, gain)
            wider = self._better(options, best, gain)
            if wider is best:
                return best
            best = wider
        return best

    def _extensions(self, best: Hypothesis, top: Sequence[Candidate]) -> list[Parts]:
        """The best with each other candidate; of a single one, also the pairs among `top` that do without it."""
        # what is wrong with a sensor too leaves no process noise: it is looked for where all else is settled
        settled = not (is_noisy(self.search.problem, best.fit) or strained(best.fit, self.claim))
        beside = [c for c in self.candidates if c.name not in best.names and (c.kind == "sensor" or not settled)]
        sets: list[Parts] = [(*best.candidates, c) for c in beside]
        if len(best.candidates) == 1 and not settled:
            sets += [(a, b) for i, a in enumerate(top) for b in top[i + 1 :] if best.candidates[0] not in (a, b)]
        return sets

    def _decided(self, base: Hypothesis, best: Hypothesis) -> tuple[Hypothesis, Hypothesis]:
        """Base, best and what comes near it, fitted to the end at the model's own substeps; base and best of these."""
        again = self.search.hypothesis((), base.fit, TO_THE_END, loosen=False)
        if best is base:
            return again, again
        near = [h for h in self.search.tried.values() if h.score - best.score < NEAR]
        fitted = self.search.fit_again(near, TO_THE_END)
        alike = [h for h in fitted if len(h.candidates) == len(best.candidates)]
        return again, self._better(alike, again, self.claim)

    def _better(
        self, options: Sequence[Hypothesis], than: Hypothesis, gain: float, *, final: bool = True
    ) -> Hypothesis:
        """The best option that gains enough and of which every part is significant; else `than`.

        Where an option leaves process noise, its intervals are too narrow and its parts must be further from neutral.
        That is not asked of an option that is still to be extended: the noise may be an effect's that joins it later.
        """
        neutral = self.search.problem.values
        for h in sorted(options, key=lambda h: h.score):
            if than.score - h.score < gain:
                break
            least = SIGNIFICANT_IN_NOISE if final and is_noisy(self.search.problem, h.fit) else SIGNIFICANT
            if all(significant(h, c, neutral, least) for c in h.candidates):
                return h
            if all(significant(h, c, neutral) for c in h.candidates):
                self.drowned.add(h.names)
        return than

    def _hidden(self, *, nothing_claimed: bool) -> tuple[str, ...]:
        """Effects that would not be identifiable at their usual size; at rest, and where nothing is claimed, all."""
        effects = [c.name for c in self.candidates if c.kind == "effect"]
        if nothing_claimed and at_rest(self.search.problem):
            return tuple(effects)
        shown = self.search.identifiable
        return tuple(name for name in effects if name in shown and shown[name] < SIGNIFICANT**2)
