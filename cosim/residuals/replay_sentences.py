"""Sentences about a comparison, each derived from the numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from cosim.base.text import amount, counted, join_names, plain, size
from cosim.logs.finding import SENSORS, Finding
from cosim.residuals.compare import ChannelSummary, Comparison
from cosim.residuals.residual_statistics import FREE_RUN


def horizon_name(horizon: float) -> str:
    """Return the name of a horizon, such as `2 s` or `free run`."""
    return "free run" if horizon == FREE_RUN else f"{horizon:g}\u00a0s"


@dataclass(frozen=True)
class _Outcome:
    """Facts from which the sentences of a verdict are made.

    Attributes:
        channels: All channels.
        measure: Horizon that decides the verdict [s].
        lost: Channels whose error windows cannot measure, because the FMU has a state that no output shows.
        beyond: Channels with errors above the noise.
        lead: Size of the error in words.
    """

    comparison: Comparison
    channels: Sequence[ChannelSummary]
    measure: float
    lost: Sequence[ChannelSummary]
    beyond: Sequence[ChannelSummary]
    lead: str


def verdict(comparison: Comparison) -> str:
    """Return the verdict, from the first rule that applies to the channels."""
    outcome = _outcome(comparison)
    rules = (_not_measured, _not_in_kind, _describe_noise, _beyond_in_free_run, _beyond_in_windows)
    return next(sentence for rule in rules if (sentence := rule(outcome)))


def _outcome(comparison: Comparison) -> _Outcome:
    channels = [c for c in comparison.channels if c.scores[c.measure].rows] or comparison.channels
    measure = channels[0].measure
    seconds = float(comparison.log.time[-1] - comparison.log.time[0])
    over = f"a free run of {plain(seconds)}\u00a0s" if measure == FREE_RUN else f"{measure:g}\u00a0s"
    beyond = sorted((c for c in channels if not (c.is_matched or c.lost)), key=lambda c: -c.excess)
    lead = f"Over {over} the model misses {_sizes(channels, measure)} (rms)"
    return _Outcome(comparison, channels, measure, [c for c in channels if c.lost], beyond, lead)


def _not_measured(o: _Outcome) -> str:
    return f"{o.lead}. {_no_measure(o.lost)}" if o.lost and not o.beyond else ""


def _not_in_kind(o: _Outcome) -> str:
    following = [c for c in o.channels if c.is_matched and not c.is_explained]
    if o.beyond or not following:
        return ""
    cause = _cause(o.comparison, following)
    return f"{o.lead}. Noise could explain that in size, but not in kind. {cause}"


def _describe_noise(o: _Outcome) -> str:
    if o.beyond:
        return ""
    return f"{o.lead}. The noise of the sensors explains that: this log shows nothing that the model lacks."


def _beyond_in_free_run(o: _Outcome) -> str:
    if o.measure != FREE_RUN:
        return ""
    worst = min(o.beyond, key=lambda c: c.scores[FREE_RUN].fit)
    fit = amount(worst.scores[FREE_RUN].fit, "%", 2)
    return f"{o.lead}. The fit of {worst.name} is {fit}. {_cause(o.comparison, o.beyond)}"


def _beyond_in_windows(o: _Outcome) -> str:
    times = join_names([f"{plain(c.excess, 2)} times for {c.name}" for c in o.beyond])
    rest = f" {_no_measure(o.lost)}" if o.lost else ""
    cause = _cause(o.comparison, o.beyond)
    return f"{o.lead}. That is more than the noise of the sensors explains: {times}. {cause}{rest}"


def _no_measure(lost: Sequence[ChannelSummary]) -> str:
    """Return sentences on channels whose error windows cannot measure, see `ChannelSummary.lost`."""
    names = join_names([c.name for c in lost])
    own = join_names([f"{c.name} by {size(c.floor.astray, c.unit)}" for c in lost])
    return (
        f"The windows do not measure {names}: this FMU keeps a state that no output shows. "
        f"Restarted from its own outputs it misses {own}. Its free run misses {_sizes(lost, FREE_RUN)}."
    )


def _sizes(channels: Sequence[ChannelSummary], horizon: float) -> str:
    return join_names([f"{c.name} by {size(c.scores[horizon].rmse, c.unit)}" for c in channels])


def _cause(comparison: Comparison, channels: Sequence[ChannelSummary]) -> str:
    """Return the probable cause of the error: a claimed error of a sensor, a delay, or an input."""
    claimed = next((f.whole for f in comparison.findings if f.kind == SENSORS), "")
    return f"{claimed[:1].upper()}{claimed[1:]}." if claimed else _cause_in_residual(comparison, channels)


def _cause_in_residual(comparison: Comparison, channels: Sequence[ChannelSummary]) -> str:
    """Return the probable cause that the residual shows: a delay, or the input that it follows."""
    names = {c.name for c in channels}
    late = [f for f in comparison.findings if f.kind == "delay" and f.channel in names]
    if late := [f for f in late if abs(f.numbers["delay"]) > comparison.log.step]:
        first = max(late, key=lambda f: abs(f.numbers["delay"]) / f.numbers["error"])
        return f"{first.whole}."
    pairs = [(c, u) for c in channels for u in c.inputs[:1] if u.stands_out]
    if not pairs:
        return (
            "No command stands out in the residual: the cause may be an effect that depends on the motion, "
            "a disturbance or a sensor. `cosim refine` distinguishes them."
        )
    channel, follows = max(pairs, key=lambda pair: pair[1].strength)
    rho = plain(float(follows.rho[follows.peak]), 2)
    why = "" if follows.ahead else ", or the loop answers a disturbance"
    return (
        f"The residual of {channel.name} follows {follows.name} (correlation {rho}): "
        f"the model's answer to that command is wrong or incomplete{why}."
    )


def whiteness_words(channel: ChannelSummary) -> str:
    """Return the words `yes`, `no` or a remark on whether the residual is white noise."""
    test = channel.whiteness
    if math.isnan(test.p_value):
        return "too few rows to tell"
    if test.white:
        return "yes"
    return "no, but no larger than noise and start explain" if channel.is_matched else "no"


def input_words(channel: ChannelSummary) -> str:
    """Return the dominant command in words, if any."""
    if not channel.inputs:
        return "no command moves"
    first = channel.inputs[0]
    distance = f"{plain(first.strength, 2)} times the band"
    return f"{first.name}, {distance}" if first.stands_out else f"none ({first.name} comes closest, {distance})"


def quality(findings: Sequence[Finding]) -> str:
    """Return the quality of the log in words."""
    warnings = sum(f.severity == "warning" for f in findings)
    if not warnings:
        return "Clock, units, signs and channels of the log are in order."
    return f"{counted(warnings, 'warning')} about the log, to be known before the numbers are believed."
