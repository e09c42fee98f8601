"""Windows of a replay, row by row; floors, lags and sentences at both sides of their limits."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from cosim.base.arrays import Array
from cosim.base.correlation import correlation_at_lags
from cosim.base.text import join_names
from cosim.base.units import read_quantity
from cosim.logs.finding import Finding
from cosim.logs.log import Log
from cosim.logs.model_comparison import delay, delays, scales
from cosim.report.charts import Charts
from cosim.residuals import floor, windows
from cosim.residuals.compare import ChannelSummary
from cosim.residuals.comparison_data import as_json
from cosim.residuals.drive import rows_of
from cosim.residuals.floor import ChannelFloor, draws
from cosim.residuals.lags import every_lag, lag_drawing, neighbours
from cosim.residuals.replay_sentences import horizon_name, input_words, quality, verdict, whiteness_words
from cosim.residuals.residual_statistics import (
    FREE_RUN,
    InputCorrelation,
    Score,
    Whiteness,
    input_correlations,
    lags_of,
    remaining_excess,
    rmse,
    whiteness,
)
from cosim.residuals.windows import Replay, chains, horizons, window_rows


def log_of(time: Array, step: float = 0.02, outputs: Any = None, inputs: Any = None, **more: Any) -> Log:
    named = {"y": np.sin(time)} if outputs is None else outputs
    units = dict.fromkeys((*named, *(inputs or {})), "rad") | more.pop("units", {})
    return Log(Path("a.csv"), time, inputs or {}, named, units, step, more.pop("written", {}), {}, **more)


def seconds(duration: float, step: float = 0.02) -> Array:
    return step * np.arange(round(duration / step) + 1)


# -- windows ----------------------------------------------------------------------------------------


def test_windows_are_consecutive_and_whole_and_begin_after_what_is_skipped() -> None:
    for duration, rows in ((9.98, [100, 200, 300]), (10.0, [100, 200, 300, 400]), (3.96, []), (3.98, []), (4.0, [100])):
        assert window_rows(log_of(seconds(duration)), 2.0) == rows
    assert window_rows(log_of(seconds(3.0)), 0.5, 0.0) == [0, 25, 50, 75, 100, 125]
    assert window_rows(log_of(7.0 + seconds(3.0)), 0.5, 1.5) == [75, 100, 125]
    # half a step short is whole: times of a recorder are rounded
    short = seconds(4.0)
    for early, count in ((0.009, 1), (0.011, 0)):
        assert len(window_rows(log_of(short - early * (np.arange(short.size) == short.size - 1)), 2.0)) == count


def test_a_window_longer_than_its_rows_goes_on_with_the_next_row() -> None:
    time = np.concatenate((seconds(0.2), 0.7 + seconds(0.2)))
    found = window_rows(log_of(time), 0.1, 0.0)
    assert found[:2] == [0, 5]
    assert 10 not in found  # nothing lies within 0.1 s of it
    assert found[-1] == 16


def test_windows_last_as_many_rows_in_a_slow_log() -> None:
    assert horizons(log_of(seconds(10.0))) == (0.5, 2.0)
    assert horizons(log_of(seconds(1000.0, 1.0), 1.0)) == (10.0, 40.0)
    assert window_rows(log_of(seconds(120.0, 1.0), 1.0), 40.0, 40.0) == [40, 80]


def test_after_a_pause_a_chain_settles_as_long_as_is_skipped_at_the_start() -> None:
    time = np.concatenate((seconds(6.0), 8.0 + seconds(6.0)))
    first, second = chains(log_of(time), 2.0)
    for chain, offset in ((first, 0), (second, 301)):
        assert chain.begin == offset + 100
        assert [k - offset for k in chain.rows if k >= chain.begin] == [100, 200, 300]
        assert all(a < b for a, b in pairwise(chain.rows))
    settle = [k - 301 for k in second.rows if k < second.begin]
    assert settle[0] == 0  # nothing is known of what was before
    assert {b - a for a, b in pairwise(settle)} == {round(windows.PAST / 0.02)}
    begin = [k for k in first.rows if k < first.begin]
    assert begin[0] == round(windows.FIRST / 0.02)
    slow = chains(log_of(seconds(200.0, 1.0), 1.0), 40.0)[0]
    assert {b - a for a, b in pairwise([k for k in slow.rows if k < slow.begin])} == {round(20 * windows.PAST)}
    assert slow.begin == 40


def test_an_output_counts_once_it_was_measured_for_as_long_as_is_skipped() -> None:
    y = np.where(seconds(10.0) < 3.0 - 1e-9, np.nan, 1.0)
    log = log_of(seconds(10.0), outputs={"y": y, "z": 0.0 * y + np.nan})
    assert windows._first_predicted(log, "y", [100, 200, 250, 300]) == 250
    assert windows._first_predicted(log, "y", [249, 251]) == 251
    assert windows._first_predicted(log, "y", [100]) == log.rows
    assert windows._first_predicted(log, "z", [100]) == log.rows


class Counter:
    """A drive whose output counts the rows since its start, from the start value on."""

    outputs, units = ("y",), {"y": "rad"}

    def __init__(self, log: Log) -> None:
        self.log, self.runs = log, list[tuple[int, int]]()

    def run(self, first: int, last: int, start: Any, memory: Any = None) -> Array:
        self.runs.append((first, last))
        return (start["y"] + np.arange(last - first + 1.0))[:, None]


def test_a_row_belongs_to_the_window_that_ends_there() -> None:
    drive: Any = Counter(log_of(seconds(1.0)))
    found = windows.windows(drive, {5: {"y": 100.0}, 15: {"y": 200.0}, 50: {"y": 0.0}}, 0.2)
    y = found.outputs["y"]
    assert drive.runs == [(5, 15), (15, 25)]  # of the last row no window begins
    assert np.flatnonzero(np.isfinite(y)).tolist() == list(range(6, 26))
    assert (y[6], y[15], y[16], y[25]) == (101.0, 110.0, 201.0, 210.0)
    with pytest.raises(ValueError, match="the window at row 14 begins before the one before it ends, at row 15"):
        windows.windows(drive, {5: {"y": 0.0}, 14: {"y": 0.0}}, 0.2)


def test_the_end_of_a_window_is_the_last_row_within_it() -> None:
    log = log_of(seconds(1.0))
    assert [rows_of(log, 10, span) for span in (0.02, 0.2, 0.5, 99.0)] == [11, 20, 35, 50]


# -- statistics -------------------------------------------------------------------------------------


def test_excess_is_a_share_of_squares_above_the_floor_from_twice_the_floor_on() -> None:
    assert remaining_excess(5.0, 3.0, 1.0) == pytest.approx(8 / 24)
    assert math.isnan(remaining_excess(2.0, 1.0, 1.0))
    assert remaining_excess(2.1, 1.0, 1.0) == 0.0
    assert math.isnan(rmse())


def test_lags_are_a_second_of_rows_and_a_quarter_of_the_log_at_most() -> None:
    for rows, step, most in ((1000, 0.02, 50), (100, 0.02, 25), (3, 0.02, 1), (1000, 1.0, 20), (1000, 0.25, 20)):
        assert lags_of(rows, step) == most
    assert lags_of(1000, 0.02, 0.5) == 25


def test_correlation_at_a_lag_is_of_what_came_later() -> None:
    rng = np.random.default_rng(1)
    a = rng.standard_normal(5000)
    b = np.roll(a, 3) + 0.5 * rng.standard_normal(5000)
    b[7::11] = np.nan
    rho = correlation_at_lags(a, b, 6)
    assert np.argmax(rho) == 6 + 3
    assert rho[9] == pytest.approx(1 / math.sqrt(1.25), abs=0.02)
    assert np.abs(np.delete(rho, 9)).max() < 0.06
    assert np.isnan(correlation_at_lags(a, 0.0 * b, 2)).all()
    assert np.isnan(correlation_at_lags(a, np.full(5000, np.nan), 2)).all()


def test_whiteness_has_a_band_and_the_chance_of_a_chi_square() -> None:
    r = np.random.default_rng(2).standard_normal(400)
    r[::9] = np.nan
    found = whiteness(r, 30)
    z, seen = np.nan_to_num(r - np.nanmean(r)), np.isfinite(r)
    n, q = int(seen.sum()), 0.0
    for k in range(1, 21):
        pairs = int((seen[:-k] & seen[k:]).sum())
        rho = float(z[:-k] @ z[k:]) / pairs / (float(z @ z) / n)
        assert found.rho[k] == pytest.approx(rho)
        q += (n + 2) / n * pairs * rho**2
    assert found.p_value == pytest.approx(float(stats.chi2.sf(q, 20)))
    assert found.band == pytest.approx(1.96 / math.sqrt(n))
    assert (found.rho.size, found.rho[0]) == (31, pytest.approx(1.0))
    assert math.isnan(whiteness(np.full(9, np.nan), 3).p_value)
    assert Whiteness(r, 0.1, 0.0101).white
    assert not Whiteness(r, 0.1, 0.01).white


def correlation(rho: Any, band: float = 0.1) -> InputCorrelation:
    half = len(rho) // 2
    return InputCorrelation("u", np.arange(-half, half + 1), np.array(rho), band)


def test_the_peak_is_among_the_lags_at_which_an_input_can_be_a_cause() -> None:
    found = correlation([0.9, 0.0, 0.9, 0.1, -0.3])
    assert (found.peak, found.strength, found.stands_out, found.ahead) == (4, pytest.approx(3.0), True, False)
    assert correlation([0.0, 0.2, 0.0, 0.25, math.nan]).ahead
    assert not correlation([0.0, 0.2, 0.0, 0.23, 0.0]).ahead
    assert not correlation([0.0, 0.0, 0.3, 0.3, 0.0]).ahead
    assert correlation([0, 0, 0, 0.21, 0]).stands_out
    assert not correlation([0, 0, 0, 0.2, 0]).stands_out


def test_the_input_that_stands_out_most_is_first_and_one_that_rests_is_none() -> None:
    rng = np.random.default_rng(3)
    u, v = rng.standard_normal(2000), rng.standard_normal(2000)
    residual = np.roll(u, 2) + 0.3 * np.roll(v, 1) + rng.standard_normal(2000)
    still = 1e6 * (1.0 + 0.9e-9 * (np.arange(2000) % 2))
    found = input_correlations(residual, {"v": v, "still": still, "u": u}, 5)
    assert [c.name for c in found] == ["u", "v"]
    assert [int(c.lags[c.peak]) for c in found] == [2, 1]
    assert found[0].band == pytest.approx(1.96 / math.sqrt(2000), rel=0.3)  # Bartlett's of two white signals
    assert input_correlations(np.where(np.arange(2000) < 2, residual, np.nan), {"u": u}, 5) == ()
    assert len(input_correlations(np.where(np.arange(2000) < 3, residual, np.nan), {"u": u}, 5)) == 1
    assert input_correlations(np.zeros(2000), {"u": u}, 5) == ()


def test_slow_signals_have_the_band_of_bartlett() -> None:
    rng, phi = np.random.default_rng(4), 0.9
    r, u = np.zeros(20_000), np.zeros(20_000)
    for x in (r, u):
        e = rng.standard_normal(x.size)
        for t in range(1, x.size):
            x[t] = phi * x[t - 1] + e[t]
    (found,) = input_correlations(r, {"u": u}, 20)
    alike = (1 + phi**2) / (1 - phi**2)  # Σ φ^2|k|
    assert found.band == pytest.approx(1.96 * math.sqrt(alike / 20_000), rel=0.25)


# -- floors -----------------------------------------------------------------------------------------


def test_few_windows_are_drawn_more_often() -> None:
    assert draws(log_of(seconds(10.0)), FREE_RUN) == 40
    assert draws(log_of(seconds(10.0)), 2.0) == 10  # four windows
    assert draws(log_of(seconds(82.0)), 2.0) == 2  # forty
    assert draws(log_of(seconds(3.0)), 2.0) == 40  # none


def test_mean_squares_are_of_the_windows_that_a_row_ends_in() -> None:
    error = np.array([9.0, 9.0, np.nan, 1.0, 3.0, 2.0, 2.0, np.nan])
    # window 1 ends with row 4, window 2 after it; rows to the first start are those before
    assert floor._mean_squares(error, [1, 4]).tolist() == [81.0, 5.0, 4.0]
    assert floor._mean_squares(error[3:], [1]).tolist() == [5.0, 4.0]


def test_the_limit_of_the_floor_is_that_of_fisher() -> None:
    rng = np.random.default_rng(5)
    squares = rng.chisquare(4, 200_000) / 4  # 4 degrees of freedom a window
    few = squares[:200]
    freedom = 2 * few.mean() ** 2 / few.var() * 200 / 10
    expected = math.sqrt(stats.f.isf(1e-4, freedom, 10 * freedom))
    assert floor._limit(few, 10) == pytest.approx(max(1.5, expected))
    fewer = few[:20]
    freedom = 2 * fewer.mean() ** 2 / fewer.var() * 2
    assert floor._limit(fewer, 10) == pytest.approx(math.sqrt(stats.f.isf(1e-4, freedom, 10 * freedom)))
    assert floor._limit(squares, 10) == 1.5  # the levels of the noise are estimates
    assert (floor._limit(np.ones(9), 3), floor._limit(np.zeros(0), 3)) == (1.5, 1.5)


def test_what_rounding_makes_is_not_astray() -> None:
    model = np.sin(np.arange(1000.0))
    for size, found in ((0.9e-4, 0.0), (1.1e-4, 1.1e-4)):
        spread = size * float(np.std(model))
        assert floor._restart_error(model, model + spread) == pytest.approx(found * float(np.std(model)))
    assert floor._restart_error(1e6 + 0 * model, 1e6 + 0.9e-3 + 0 * model) == 0.0
    assert floor._restart_error(1e6 + 0 * model, 1e6 + 1.5e-3 + 0 * model) == pytest.approx(1.5e-3, rel=1e-3)
    assert floor._restart_error(model * np.nan, model) == 0.0


# -- against a model --------------------------------------------------------------------------------


def shaken(shift: float = 0.0, noise: float = 0.01, duration: float = 40.0) -> tuple[Log, Array]:
    """A log of a signal of many tones that trails its model by `shift` seconds."""
    t, rng = seconds(duration), np.random.default_rng(7)
    tones = [(2 * math.pi * f, p) for f, p in zip(rng.uniform(0.4, 4.0, 12), rng.uniform(0, 6.28, 12), strict=True)]
    model, measured = (np.sum([np.sin(w * (t - s) + p) for w, p in tones], axis=0) for s in (0.0, shift))
    return log_of(t, outputs={"y": measured + noise * rng.standard_normal(t.size)}), model


@pytest.mark.parametrize("shift", [0.05, -0.05, 0.013, 0.2])
def test_a_delay_is_found_to_a_part_of_a_row(shift: float) -> None:
    log, model = shaken(shift)
    found = delay(log, log.outputs["y"], model)
    assert found is not None
    assert found.time == pytest.approx(shift, abs=max(0.001, 3 * found.error))
    assert 0.02 * log.step <= found.error < 0.005
    (told,) = delays(log, {"y": model})
    assert told.severity == ("warning" if abs(shift) > 0.02 else "note")
    assert told.sentence.startswith("trails" if shift > 0 else "leads")
    assert list(delays(log, {"other": model})) == []


def test_no_delay_is_told_of_less_than_half_a_row_or_of_what_is_unlike() -> None:
    log, model = shaken(0.006)
    assert list(delays(log, {"y": model})) == []
    other = np.random.default_rng(9).standard_normal(model.size)
    assert delay(log, log.outputs["y"], other) is None
    far, model = shaken(0.6)  # beyond the longest
    found = delay(far, far.outputs["y"], model)
    assert found is None or abs(found.time) <= 0.5


@pytest.mark.parametrize(
    ("factor", "kind"),
    [(1.0, None), (-1.0, "sign"), (57.3, "unit"), (40.0, None), (45.0, "unit"), (90.0, None), (4.9, None)],
)
def test_a_signal_in_another_unit_moves_as_the_model_does_but_so_many_times_as_far(factor: float, kind: Any) -> None:
    log, model = shaken()
    log = replace(log, outputs={"y": factor * log.outputs["y"]})
    found = list(scales(log, {"y": model}))
    assert [f.kind for f in found] == ([kind] if kind else [])
    if kind:
        assert found[0].numbers["slope"] == pytest.approx(factor, rel=0.01)
        assert found[0].severity == ("warning" if kind == "sign" else "fault")
    assert list(scales(log, {"y": 0.0 * model})) == []


# -- words ------------------------------------------------------------------------------------------


def channel(
    name: str = "y", error: float = 1.0, noise: float = 1.0, limit: float = 1.5, astray: float = 0.0, **more: Any
) -> ChannelSummary:
    scores = more.get(
        "scores", {2.0: Score(error, more.get("fit", 50.0), 100), FREE_RUN: Score(7.0 * error, 20.0, 200)}
    )
    inputs = more.get("inputs", ())
    white = more.get("whiteness", Whiteness(np.array([1.0, 0.3]), 0.1, 0.5))
    return ChannelSummary(name, "m", 2.0, 0.1, ChannelFloor(noise, limit, astray), scores, white, inputs)


def comparison(*channels: ChannelSummary, findings: Any = ()) -> Any:
    log = log_of(seconds(10.0), outputs={c.name: seconds(10.0) for c in channels})
    return SimpleNamespace(channels=channels, log=log, findings=tuple(findings))


def said(*channels: ChannelSummary, **more: Any) -> str:
    return verdict(comparison(*channels, **more)).replace("\u00a0", " ")


def follows(strength: float, name: str = "u") -> InputCorrelation:
    return replace(correlation([0.0, 0.0, 0.0, 0.1 * strength, 0.0]), name=name)


def test_a_channel_is_matched_up_to_the_limit_of_its_floor() -> None:
    assert channel(error=1.49).is_matched
    assert not channel(error=1.5).is_matched
    assert channel(error=3.0).excess == 3.0
    assert channel(error=1.0, noise=0.0, fit=99.995).is_matched
    assert not channel(error=1.0, noise=0.0, fit=99.985).is_matched
    assert channel(error=1.0, astray=1.5).lost
    assert not channel(error=1.0, astray=1.0).lost
    assert math.isnan(channel(astray=2.0).excess)
    assert not channel(error=0.0, astray=2.0).is_matched
    assert channel(error=0.0, noise=0.0).exact
    free = channel(scores={FREE_RUN: Score(3.0, 20.0, 9)})
    assert (free.measure, channel().measure) == (FREE_RUN, 2.0)


def test_what_is_matched_is_explained_unless_it_follows_a_command() -> None:
    assert channel(inputs=(follows(2.4), follows(9.0))).is_explained  # the first is the one that stands out most
    assert not channel(inputs=(follows(2.6),)).is_explained
    assert channel(fit=99.995, inputs=(follows(2.6),)).is_explained
    assert not channel(error=2.0).is_explained


def test_the_verdict_is_the_first_that_applies() -> None:
    noise = "The noise of the sensors explains that: this log shows nothing that the model lacks."
    assert said(channel(error=0.5)) == f"Over 2 s the model misses y by 0.500 m (rms). {noise}"
    assert "could explain that in size, but not in kind. The residual of y follows u" in said(
        channel(inputs=(follows(3.0),))
    )
    far = said(channel("x", 2.0), channel("y", 3.0), channel("z", 0.5), channel("w", 4.0))
    assert "sensors explains: 4.0 times for w, 3.0 times for y and 2.0 times for x." in far
    assert far.startswith("Over 2 s the model misses x by 2.00 m, y by 3.00 m, z by 0.500 m and 1 more (rms). ")
    lost = said(channel("x", 0.5, astray=3.0))
    assert "The windows do not measure x: " in lost
    assert "Restarted from its own outputs it misses x by 3" in lost
    both = said(channel("x", 0.5, astray=3.0), channel("y", 5.0))
    assert "explains: 5.0 times for y" in both
    assert both.endswith("Its free run misses x by 3.50 m.")
    free = said(
        channel("x", scores={FREE_RUN: Score(9.0, 30.0, 9)}), channel("y", scores={FREE_RUN: Score(9.0, 20.0, 9)})
    )
    assert free.startswith(
        "Over a free run of 10.0 s the model misses x by 9.00 m and y by 9.00 m (rms). The fit of y is 20 %."
    )


def test_the_cause_is_a_delay_of_more_than_a_row_or_a_command_that_stands_out() -> None:
    def late(name: str, by: float, error: float = 0.001) -> Finding:
        return Finding("warning", "delay", name, f"trails by {by} s", {"delay": by, "error": error})

    far = channel("y", 5.0), channel("x", 4.0)
    assert "No command stands out" in said(*far)
    assert "No command stands out" in said(*far, findings=[late("y", 0.019), late("other", 0.5)])
    told = said(*far, findings=[late("y", 0.03), late("x", -0.05)])
    assert "x trails by -0.05 s." in told
    assert "y trails by 0.03 s." in said(*far, findings=[late("y", 0.03), late("x", -0.05, 0.01)])
    named = said(channel("y", 5.0, inputs=(follows(3.0),)), channel("x", 4.0, inputs=(follows(4.0, "v"),)))
    assert "The residual of x follows v (correlation 0.40): the model's answer to that command is wrong" in named
    assert named.endswith("incomplete.")
    loop = replace(follows(3.0), rho=np.array([0.0, 0.3, 0.0, 0.3, 0.0]))
    assert said(channel("y", 5.0, inputs=(loop,))).endswith(", or the loop answers a disturbance.")


def test_words_for_whiteness_inputs_and_the_log() -> None:
    for chance, error, words in (
        (math.nan, 1.0, "too few rows to tell"),
        (0.02, 1.0, "yes"),
        (0.005, 1.0, "no, but no larger than noise and start explain"),
        (0.005, 2.0, "no"),
    ):
        assert whiteness_words(channel(error=error, whiteness=Whiteness(np.ones(2), 0.1, chance))) == words
    assert input_words(channel()) == "no command moves"
    assert input_words(channel(inputs=(follows(1.5),))) == "none (u comes closest, 1.5 times the band)"
    assert input_words(channel(inputs=(follows(3.0),))) == "u, 3.0 times the band"
    warning, note = (Finding(s, "k", "y", "is") for s in ("warning", "note"))  # type: ignore[arg-type]
    assert quality([note]) == "Clock, units, signs and channels of the log are in order."
    assert quality([warning, note, warning]).startswith("2 warnings about the log")
    names = ([], ["a"], ["a", "b"], ["a", "b", "c"], ["a", "b", "c", "d", "e"])
    assert [join_names(w) for w in names] == ["", "a", "a and b", "a, b and c", "a, b, c and 2 more"]
    assert (horizon_name(FREE_RUN), horizon_name(2.0)) == ("free run", "2\u00a0s")


def test_numbers_for_scripts_are_finite_or_null() -> None:
    (found,) = as_json(comparison(channel(error=3.0, noise=0.0, limit=1.5)))
    assert (found["rmse"], found["fit"], found["rows"], found["horizon"]) == (3.0, 50.0, 100, 2.0)
    assert (found["times_noise"], found["noise_floor"]) == (None, 0.0)
    assert found["free_run"] == {"rmse": 21.0, "fit": 20.0, "rows": 200}
    assert found["windows"] == [{"horizon": 2.0, "rmse": 3.0, "fit": 50.0, "rows": 100}]
    (free,) = as_json(comparison(channel(scores={FREE_RUN: Score(math.nan, math.nan, 0)})))
    assert (free["horizon"], free["rmse"]) == (None, None)


def test_stems_are_about_as_many_as_asked_for_and_begin_with_one_row() -> None:
    assert every_lag(50, 50).tolist() == list(range(1, 51))
    assert every_lag(100, 50).tolist() == list(range(1, 101, 2))
    assert every_lag(98, 50).tolist() == list(range(1, 99))
    assert every_lag(99, 50).tolist() == list(range(1, 100, 2))
    assert every_lag(3, 50).tolist() == [1, 2, 3]
    assert neighbours(Whiteness(np.array([1.0, 0.256]), 0.1, 0.5)) == "0.26"
    assert neighbours(Whiteness(np.array([1.0]), 0.1, 0.5)) == "–"


@pytest.mark.parametrize(
    ("rows", "ends"), [([1, 2, 3], (0.01, 0.07)), ([1, 4, 7], (-0.01, 0.17)), ([-4, 0, 4], (-0.12, 0.12)), ([5], None)]
)
def test_stems_stand_at_their_lags_with_half_a_lag_free_at_each_end(rows: list[int], ends: Any) -> None:
    charts = Charts()
    np.testing.assert_allclose(lag_drawing(charts, np.array(rows), 0.02).x, 0.02 * np.array(rows))
    assert json.loads(charts.data())["groups"][0]["ends"] == pytest.approx(ends or (0.09, 0.11))


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [("180 deg", "rad", math.pi), ("-1.5e3", "", -1500.0), (" .5 ", "m", 0.5), ("2. cm", "m", 0.02), ("+3", "1", 3.0)],
)
def test_a_start_value_is_a_number_in_a_unit_of_its_variable(text: str, unit: str, value: float) -> None:
    assert read_quantity(text, unit) == pytest.approx(value)


@pytest.mark.parametrize(("text", "unit"), [("1 kg", "m"), ("1 m", ""), ("m", "m"), ("1e999", "m"), ("1,5", "m")])
def test_a_start_value_that_is_no_such_number_is_refused(text: str, unit: str) -> None:
    with pytest.raises(ValueError, match=r"it is (a number|not finite)"):
        read_quantity(text, unit)


def test_errors_of_a_replay_are_measured_minus_model() -> None:
    log = log_of(seconds(0.1))
    found = Replay(log.time, 2.0, {}, {"y": np.ones(log.rows)}, {})
    assert found.errors(log)["y"] == pytest.approx(log.outputs["y"] - 1.0)
