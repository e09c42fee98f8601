"""Faults of planned phases before a simulation of the bench, each at its line, once for all runs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cosim.base.errors import Fault
from cosim.base.text import counted
from cosim.storage.yaml_file import YamlFile
from plant.bench import REST_DUTY, Bench
from plant.identification.columns import MIN_HEIGHT_RATIO
from plant.identification.commanded import LEAST_ROWS, ROWS_PER_PERIOD, lacks, windows_of
from plant.identification.protocol import BENCH, LONGEST, HeightTest, ProtocolFile, SineTest, Test
from plant.identification.recordings import Recording, commands

MOST_ROWS = 1_000_000  # rows of a run


def planned_faults(yaml: YamlFile, content: ProtocolFile, known: Bench) -> list[Fault]:
    """Return every fault of the simulated tests with valid keys and values."""
    tests = [(n, t) for n, t in content.tests.named_tests() if not t.files]
    if faults := list(_step_faults(yaml, content, tests)):
        return faults
    own = content.bench == BENCH
    return [fault for name, test in tests for fault in _faults(yaml, content, name, test, known, own)]


def _step_faults(yaml: YamlFile, content: ProtocolFile, tests: list[tuple[str, Test]]) -> Iterator[Fault]:
    """Yield a fault of a step too long for windows and sines, or too short to simulate."""
    step = content.step
    if step < LONGEST / MOST_ROWS and (longest := max((_end(t) for _, t in tests), default=0.0)) / step > MOST_ROWS:
        rows, least_step = f"{longest / step:.3g}", f"{longest / MOST_ROWS:.1g}"
        message = f"a run of {longest:g} s has {rows} rows, {MOST_ROWS} at most; {least_step} s or more"
        yield yaml.fault(("step",), message)
        return
    least = []
    for n, t in tests:
        least += [((end - start) / LEAST_ROWS, f"tests.{n}.{key}") for key, (start, end) in windows_of(t).items()]
        for w in t.frequencies if isinstance(t, SineTest) else ():
            least.append((2.0 * np.pi / w / ROWS_PER_PERIOD, f"a period of tests.{n} at {w:g} rad/s"))
    short = sorted(pair for pair in least if pair[0] < step * (1.0 - 1e-9))
    if len(short) > 1:
        others = f"{short[0][1]} and {counted(len(short) - 1, 'other')}"
        message = f"{step:g} s is too long: {others} need {LEAST_ROWS} rows; {short[0][0]:.3g} s or less"
        yield yaml.fault(("step",), message)


def _end(test: Test) -> float:
    if isinstance(test, SineTest):
        slowest = max((2.0 * np.pi * n / w for n, w in zip(test.periods, test.frequencies, strict=False)), default=0.0)
        return test.lead + max(slowest, test.skip + 1.0)
    return test.phases[-1][0] if test.phases else 0.0


def _faults(yaml: YamlFile, content: ProtocolFile, name: str, test: Test, known: Bench, own: bool) -> Iterator[Fault]:
    at = ("tests", name)
    validation = True
    if isinstance(test, HeightTest):
        yield from _height_faults(yaml, test, known)
        if test.validation_duty is not None:
            wrong = list(_validation_faults(yaml, test, known, own))
            validation = not wrong
            yield from wrong
    if isinstance(test, SineTest):
        yield from _sine_faults(yaml, content, test)
    told: set[tuple[str, str]] = set()
    for label, time, duty, servo_duty, height in commands(test, known, content.step):
        if label.endswith("validation") and not validation:
            continue
        run = Recording(name + label, time, duty, servo_duty, np.full(time.size, height), {})
        for lack in lacks(known, name, test, run, ".".join(at), own=own):
            if (lack.key, lack.plan) not in told:
                told.add((lack.key, lack.plan))
                yield yaml.fault((*at, lack.key), f"{lack.what}; {lack.plan}")


def _height_faults(yaml: YamlFile, test: HeightTest, known: Bench) -> Iterator[Fault]:
    at, radius = ("tests", "ground_effect"), known.propeller_radius
    for k, height in enumerate(test.heights):
        if height in test.heights[:k]:
            yield yaml.fault((*at, "heights", k), f"{height:g} stands twice; repetitions are more runs at each height")
        elif height < MIN_HEIGHT_RATIO:
            message = f"{height:g} radii: the ground effect of eq 4.28 ends at {MIN_HEIGHT_RATIO:g}; write that or more"
            yield yaml.fault((*at, "heights", k), message)
    if test.free_height <= max(test.heights) * radius:
        message = f"{test.free_height:g} m is no higher than the heights near the ground, up to "
        message += f"{max(test.heights) * radius:.3g} m ({max(test.heights):g} radii of {radius:g} m); nothing is below"
        yield yaml.fault((*at, "free_height"), f"{message} from some 10 radii on")


def _validation_faults(yaml: YamlFile, test: HeightTest, known: Bench, own: bool) -> Iterator[Fault]:
    duty, top = test.validation_duty or 0.0, max(p[1] for p in test.phases)
    idle = -known.thrust_offset / known.thrust_slope if own else REST_DUTY
    at = ("tests", "ground_effect", "validation_duty")
    if duty <= idle:
        yield yaml.fault(at, f"{duty:g} % gives no thrust, which begins above {idle:.4g} %; write a higher one")
    elif duty == top:
        yield yaml.fault(at, f"{duty:g} % is that of the phases; a validation set has another duty, or leave it out")


def _sine_faults(yaml: YamlFile, content: ProtocolFile, test: SineTest) -> Iterator[Fault]:
    for k, w in enumerate(test.frequencies):
        place = ("tests", "frequency", "frequencies", k)
        if w in test.frequencies[:k]:
            yield yaml.fault(place, f"{w:g} rad/s stands twice; repetitions are more runs at each frequency")
        elif w * content.step > 2.0 * np.pi / ROWS_PER_PERIOD * (1.0 + 1e-9):
            most = 2.0 * np.pi / ROWS_PER_PERIOD / content.step
            message = f"{w:g} rad/s at a step of {content.step:g} s is less than {ROWS_PER_PERIOD} rows a period"
            yield yaml.fault(place, f"{message}; {most:.3g} rad/s or less, or a shorter `step`")
