"""A comparison in words; each sentence follows from the numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence

from cosim.logs.finding import Finding
from cosim.residuals.compare import ChannelSummary, Comparison
from cosim.residuals.statistics import FREE_RUN
from cosim.text import amount, counted, plain, size


def horizon_name(horizon: float) -> str:
    """`2 s`, `free run`."""
    return "free run" if horizon == FREE_RUN else f"{horizon:g}\u00a0s"


def verdict(comparison: Comparison) -> str:
    """How far the model is off, whether noise explains that, and what the rest follows."""
    log = comparison.log
    channels = [c for c in comparison.channels if c.scores[c.measure].rows] or comparison.channels
    measure = channels[0].measure
    over = (
        f"a free run of {plain(float(log.time[-1] - log.time[0]))}\u00a0s"
        if measure == FREE_RUN
        else f"{measure:g}\u00a0s"
    )
    lead = f"Over {over} the model misses {_sizes(channels, measure)} (rms)"
    lost = [c for c in channels if c.lost]
    beyond = sorted((c for c in channels if not (c.matched or c.lost)), key=lambda c: -c.excess)
    if lost and not beyond:
        return f"{lead}. {_no_measure(lost)}"
    if following := [c for c in channels if c.matched and not c.explained and not beyond]:
        return f"{lead}, which noise could explain in size, but not in kind. {_cause(comparison, following)}"
    if not beyond:
        return f"{lead}, no more than the noise of the sensors explains: this log shows nothing that the model lacks."
    if measure == FREE_RUN:
        worst = min(beyond, key=lambda c: c.scores[measure].fit)
        return f"{lead}; {worst.name} fits to {amount(worst.scores[measure].fit, '%', 2)}. {_cause(comparison, beyond)}"
    times = [
        f"{plain(c.excess, 2)} times {'what the noise of the sensors explains ' * (c is beyond[0])}for {c.name}"
        for c in beyond
    ]
    rest = f" {_no_measure(lost)}" if lost else ""
    return f"{lead}. That is {_and(times)}. {_cause(comparison, beyond)}{rest}"


def _no_measure(lost: Sequence[ChannelSummary]) -> str:
    """Which channels windows do not measure, how that shows, and what the free run says of them."""
    names = _and([c.name for c in lost])
    own = _and([f"{c.name} by {size(c.floor.astray, c.unit)}" for c in lost])
    return (
        f"The windows do not measure {names}: restarted from its own outputs this FMU misses {own}, "
        f"for it keeps a state that no output shows. Its free run misses {_sizes(lost, FREE_RUN)}."
    )


def _sizes(channels: Sequence[ChannelSummary], horizon: float) -> str:
    return _and([f"{c.name} by {size(c.scores[horizon].rmse, c.unit)}" for c in channels])


def _cause(comparison: Comparison, channels: Sequence[ChannelSummary]) -> str:
    """A delay, or which command the misfit follows."""
    names = {c.name for c in channels}
    late = [f for f in comparison.findings if f.kind == "delay" and f.channel in names]
    if late := [f for f in late if abs(f.numbers["delay"]) > comparison.log.step]:
        first = max(late, key=lambda f: abs(f.numbers["delay"]) / f.numbers["error"])
        return f"{first.whole}."
    pairs = [(c, u) for c in channels for u in c.inputs[:1] if u.stands_out]
    if not pairs:
        return (
            "No command stands out in the residual: an effect that depends on the motion, a disturbance or a sensor; "
            "`cosim refine` tells them apart."
        )
    channel, found = max(pairs, key=lambda pair: pair[1].strength)
    rho = plain(float(found.rho[found.peak]), 2)
    why = "" if found.ahead else ", or the loop answers a disturbance"
    return (
        f"The residual of {channel.name} follows {found.name} (correlation {rho}): "
        f"the model's answer to that command is wrong or incomplete{why}."
    )


def whiteness_words(channel: ChannelSummary) -> str:
    """White or not."""
    test = channel.whiteness
    if math.isnan(test.p_value):
        return "too few rows to tell"
    if test.white:
        return "white"
    return "not white, yet no larger than noise and start explain" if channel.matched else "not white"


def input_words(channel: ChannelSummary) -> str:
    """The command that stands out, or that none does."""
    if not channel.inputs:
        return "no command moves"
    found = channel.inputs[0]
    if not found.stands_out:
        return f"none ({found.name} comes closest, {plain(found.strength, 2)} times the band)"
    return f"{found.name}, {plain(found.strength, 2)} times the band"


def quality(findings: Sequence[Finding]) -> str:
    """How sound the log is."""
    warnings = sum(f.severity == "warning" for f in findings)
    if not warnings:
        return "Clock, units, signs and channels of the log are in order."
    return f"{counted(warnings, 'warning')} about the log, to be known before the numbers are believed."


def _and(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}" if words else ""
