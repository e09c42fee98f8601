"""Faults of planned phases before a simulation of the bench, each at its line, once for all runs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cosim.base.errors import Fault
from cosim.base.text import counted
from cosim.storage.yaml_file import YamlFile
from plant.bench import REST_DUTY, Bench
from plant.identification import messages
from plant.identification.checks import MIN_ROWS, ROWS_PER_PERIOD, lacks, windows_of
from plant.identification.protocol import BENCH, MAX_RUN_TIME, HeightTest, ProtocolFile, SineTest, Test
from plant.identification.recordings import Recording, commands

MAX_ROWS = 1_000_000  # rows of a run
MIN_HEIGHT_RATIO = 0.5  # least ratio of height to propeller radius in eq 4.28


def planned_faults(yaml: YamlFile, content: ProtocolFile, bench: Bench) -> list[Fault]:
    """Return every fault of the simulated tests with valid keys and values."""
    tests = [(n, t) for n, t in content.tests.named_tests() if not t.files]
    if faults := list(_step_faults(yaml, content, tests)):
        return faults
    own = content.bench == BENCH
    return [fault for name, test in tests for fault in _faults(yaml, content, name, test, bench, own)]


def _step_faults(yaml: YamlFile, content: ProtocolFile, tests: list[tuple[str, Test]]) -> Iterator[Fault]:
    """Yield a fault of a step too long for windows and sines, or too short to simulate."""
    step = content.step
    if step < MAX_RUN_TIME / MAX_ROWS and (longest := max((_end(t) for _, t in tests), default=0.0)) / step > MAX_ROWS:
        rows, least = longest / step, longest / MAX_ROWS
        yield yaml.fault(("step",), messages.SHORT_STEP(time=longest, rows=rows, limit=MAX_ROWS, least=least))
        return
    limits = []
    for n, t in tests:
        limits += [((end - start) / MIN_ROWS, f"tests.{n}.{key}") for key, (start, end) in windows_of(t).items()]
        for w in t.frequencies if isinstance(t, SineTest) else ():
            limits.append((2.0 * np.pi / w / ROWS_PER_PERIOD, f"a period of tests.{n} at {w:g} rad/s"))
    short = sorted(pair for pair in limits if pair[0] < step * (1.0 - 1e-9))
    if len(short) > 1:
        (limit, place), others = short[0], counted(len(short) - 1, "other")
        fields = {"step": step, "place": place, "others": others, "least": MIN_ROWS, "limit": limit}
        yield yaml.fault(("step",), messages.LONG_STEP(**fields))


def _end(test: Test) -> float:
    if isinstance(test, SineTest):
        slowest = max((2.0 * np.pi * n / w for n, w in zip(test.periods, test.frequencies, strict=False)), default=0.0)
        return test.lead + max(slowest, test.skip + 1.0)
    return test.phases[-1][0] if test.phases else 0.0


def _faults(yaml: YamlFile, content: ProtocolFile, name: str, test: Test, bench: Bench, own: bool) -> Iterator[Fault]:
    at = ("tests", name)
    validation_faults: list[Fault] = []
    if isinstance(test, HeightTest):
        yield from _height_faults(yaml, test, bench)
        if test.validation_duty is not None:
            validation_faults += _validation_faults(yaml, test, test.validation_duty, bench, own)
            yield from validation_faults
    if isinstance(test, SineTest):
        yield from _sine_faults(yaml, content, test)
    earlier: set[tuple[str, str]] = set()
    for label, time, duty, servo_duty, height in commands(test, bench, content.step):
        if label.endswith("validation") and validation_faults:
            continue
        run = Recording(name + label, time, duty, servo_duty, np.full(time.size, height), {})
        for key, _, message in lacks(bench, name, test, run, own=own):
            if (key, message) not in earlier:
                earlier.add((key, message))
                yield yaml.fault((*at, key), message)


def _height_faults(yaml: YamlFile, test: HeightTest, bench: Bench) -> Iterator[Fault]:
    at, radius = ("tests", "ground_effect"), bench.propeller_radius
    for k, height in enumerate(test.heights):
        if height in test.heights[:k]:
            yield yaml.fault((*at, "heights", k), messages.REPEATED_HEIGHT(height=height))
        elif height < MIN_HEIGHT_RATIO:
            yield yaml.fault((*at, "heights", k), messages.HEIGHT_IN_GROUND(height=height, least=MIN_HEIGHT_RATIO))
    ratio = max(test.heights)
    if test.free_height <= ratio * radius:
        fields = {"height": test.free_height, "limit": ratio * radius, "ratio": ratio, "radius": radius}
        yield yaml.fault((*at, "free_height"), messages.LOW_FREE_HEIGHT(**fields))


def _validation_faults(yaml: YamlFile, test: HeightTest, duty: float, bench: Bench, own: bool) -> Iterator[Fault]:
    idle = -bench.thrust_offset / bench.thrust_slope if own else REST_DUTY
    at = ("tests", "ground_effect", "validation_duty")
    if duty <= idle:
        yield yaml.fault(at, messages.VALIDATION_WITHOUT_THRUST(duty=duty, limit=idle))
    elif duty == max(p[1] for p in test.phases):
        yield yaml.fault(at, messages.VALIDATION_DUTY_OF_PHASES(duty=duty))


def _sine_faults(yaml: YamlFile, content: ProtocolFile, test: SineTest) -> Iterator[Fault]:
    limit = 2.0 * np.pi / ROWS_PER_PERIOD / content.step
    for k, w in enumerate(test.frequencies):
        place = ("tests", "frequency", "frequencies", k)
        if w in test.frequencies[:k]:
            yield yaml.fault(place, messages.REPEATED_FREQUENCY(frequency=w))
        elif w * content.step > 2.0 * np.pi / ROWS_PER_PERIOD * (1.0 + 1e-9):
            fields = {"frequency": w, "step": content.step, "least": ROWS_PER_PERIOD, "limit": limit}
            yield yaml.fault(place, messages.HIGH_FREQUENCY(**fields))
