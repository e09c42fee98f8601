"""`cosim excite`: the input that best separates rival hypotheses, and a scenario that applies this input.

Random experiments are simulated without noise and scaled to the limits. The best experiment separates the most pairs of
rivals and, among equals, has the largest distance of the closest separated pair. A pair that no input separates does
not influence the choice.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from shutil import copyfile

import numpy as np

from cosim.core import registry
from cosim.core.arrays import Array
from cosim.core.errors import InputError
from cosim.core.settings import Count, ModelName, Names, PositiveSeconds, Seed
from cosim.core.text import counted, join_names, showing
from cosim.estimation.posing import build_problem, coarsen
from cosim.estimation.subject.fmu_subject import FmuSubject
from cosim.experiment.question import MIN_SEPARATION, Pair, Question, ask, refinement_folder, separation
from cosim.experiment.rigs import FmuOpenLoop, OpenLoop, RigAxis, Trial
from cosim.files.csv_source import write_columns
from cosim.files.files import FilePath, check_writable, write_text
from cosim.files.folders import new_run, remove_earlier
from cosim.logs.log import slowness

EXPERIMENTS = 48
DURATION, SHORTEST, LONGEST = 40.0, 5.0, 600.0  # [s], for a model with a step of at most 50 ms
MAX_RIVALS = 4  # rivals simulated for every preferred experiment; the others are simulated at the end
EXCURSION_SHARE = 0.95  # share of the allowed excursion to which a second attempt is scaled
SMALLER = 5  # number of times that an input is reduced for a rival that exceeds the limits
MIN_DISTANCE = 1.0  # standard deviations below which noise hides the difference
MULTISINE_TONES = 12
MAX_PARTS = 6  # parts of a trial in which an axis moves or rests
MOVE_PROBABILITY = 0.75  # probability that an axis moves in a part
AMPLITUDE_SHARE = (0.3, 1.0)  # share of an axis' amplitude
INPUT_SHAPES = ("multisine", "chirp", "steps", "ramps")
MAX_LISTED_PAIRS = 5  # pairs listed in the terminal
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Excitation:
    """A designed experiment, simulated with the model and with each rival hypothesis.

    Attributes:
        trial, rivals: Simulations of the model and of each rival with the same input signals.
        apart: Distance of each pair of rivals [standard deviations].
        usual: Distance of each pair with the usual input, for comparison [standard deviations].
    """

    question: Question
    rig: OpenLoop
    trial: Trial
    rivals: Mapping[str, Trial]
    apart: Mapping[Pair, float]
    usual: Mapping[Pair, float]

    @property
    def excess(self) -> float:
        """Return the largest excursion relative to its limit, for the model and all rivals."""
        return max(trial.excess(self.question.limits) for trial in (self.trial, *self.rivals.values()))

    @property
    def score(self) -> tuple[int, float]:
        """Return the merit (see `merit_of`), reduced if a rival exceeds the limits."""
        return merit_of(self.apart, max(1.0, self.excess))

    @property
    def headline(self) -> str:
        """Return a sentence with the number of separated pairs of rivals and the pair that is hardest to separate."""
        count, _ = merit_of(self.apart)
        a, b = self.hardest_first[0]
        return (
            f"The input separates {count} of {counted(len(self.apart), 'pair')} of rivals; {a} and {b} are "
            f"{self.apart[a, b]:.1f} standard deviations apart ({MIN_SEPARATION:g} required)."
        )

    @property
    def distances(self) -> list[str]:
        """Return a line per pair, the hardest pair first."""
        return [
            f"{a} from {b}: {self.apart[a, b]:.1f} standard deviations ({self.rig.usual}: {self.usual[a, b]:.1f})"
            for a, b in self.hardest_first
        ]

    @property
    def sentences(self) -> list[str]:
        """Return lines on the pairs of rivals that are hardest to separate, and a line on the ranges of the outputs.

        excitation.yaml lists all pairs.
        """
        units = {q.name: q.unit for q in self.question.loaded.model.outputs}
        names = [n for n in units if n in self.question.limits] or self.question.measured
        outputs = self.trial.outputs
        ranges = ", ".join(f"{n} {outputs[n].min():.3g} to {outputs[n].max():.3g} {units[n]}" for n in names)
        return [*self.distances[:MAX_LISTED_PAIRS], f"excursion: {ranges}"]

    @property
    def warnings(self) -> list[str]:
        """Return warnings about inseparable pairs, and about excursions beyond the limits."""
        warnings = []
        if self.excess > 1.0:
            far = "diverge" if math.isinf(self.excess) else f"reach {self.excess:.2g} times the value of --limit"
            beyond = [n for n, trial in self.rivals.items() if trial.excess(self.question.limits) > 1.0]
            cause = f" if {join_names(beyond)} is true" if beyond else ""
            warnings.append(
                f"no input within --limit was found: even with the smallest one, the outputs {far}{cause}. Do not use "
                "this input on the machine. Widen --limit, or test fewer hypotheses"
            )
        if pairs := [f"{a} from {b}" for a, b in self.hardest_first if self.apart[a, b] < MIN_SEPARATION]:
            warnings.append(
                f"the best input does not separate {join_names(pairs)} (less than {MIN_SEPARATION:g} standard "
                "deviations apart); try a wider --limit, a longer --duration or more outputs --measured"
            )
        return warnings

    @property
    def hardest_first(self) -> list[Pair]:
        """Return pairs of rivals, the hardest to separate first."""
        return sorted(self.apart, key=lambda pair: self.apart[pair])


def merit_of(apart: Mapping[Pair, float], excess: float = 1.0) -> tuple[int, float]:
    """Return the number of separated pairs and the smallest of their distances.

    If no pair is separated, the second value is the largest distance.

    Args:
        apart: Distance of each pair [standard deviations].
        excess: Largest excursion relative to its limit; above 1, it reduces the distances.
    """
    distances = [distance / excess for distance in apart.values()]
    separated = [distance for distance in distances if distance >= MIN_SEPARATION]
    return len(separated), min(separated, default=max(distances))


def excite(
    text: ModelName,
    folder: FilePath,
    against: Names = (),
    *,
    limits: Names = (),
    ranges: Names = (),
    measured: Names = (),
    duration: PositiveSeconds | None = None,
    seed: Seed = 1,
    experiments: Count = EXPERIMENTS,
    report: bool = True,
    force: bool = False,
    progress: Progress | None = None,
) -> Excitation:
    """Design the input that separates rival hypotheses best.

    Args:
        text: Registered model, model.yaml, FILE.py:Class, FMU, refine.json or its folder.
        folder: Folder for excitation.csv, excitation.yaml and the FMUs.
        against: Effects, sensor errors or parameters that are rival hypotheses.
        limits: Texts "name=value": largest distance of an input or output from its start value.
        ranges: Texts "name=min..max": range of an input.
        measured: Outputs that will be logged.
        duration: Duration of the experiment [s], or text with a unit.
        seed: Seed for the random experiments.
        experiments (in Python): Number of random experiments.
        report: Write report.html.
        force: Write even if the folder has results of another command.
        progress (in Python): Function of (stage, completed share).

    Returns:
        The chosen experiment and the distance of each pair of hypotheses [standard deviations].

    Raises:
        InputError: The input is wrong (the error names all faults), or no experiment separates any pair.
    """
    from cosim.fmi.fmu_build import build

    show_stage = progress or (lambda stage, share: None)
    show_stage("reading the model", 0.0)
    with new_run(folder, "", "cosim excite", force=force) as place:
        question = ask(text, against, limits, measured, ranges, duration)
        model = question.loaded.model
        time = _times(text, model.rate, duration)
        common = (question.limits, question.ranges, float(time[-1]))
        if isinstance(question.subject, FmuSubject):
            rig: OpenLoop = FmuOpenLoop(question.subject, question.first, *common)
        else:  # of the model's class, otherwise the general one
            entry = registry.entry_of(type(model))
            rig = (registry.resolve(entry.rig) if entry and entry.rig else OpenLoop)(model, *common)
        files = ("excitation.csv", "excitation.yaml", "plant.fmu", "report.html", *rig.files)
        check_writable(place, files, [source / "plant.fmu"] if (source := refinement_folder(text)) else [])
        excitation = _choose(question, rig, time, seed, experiments, show_stage)
        none = f"none of {experiments} experiments"
        if excitation is None:
            raise InputError.at(Path(text), f"{none} stays within the limits; widen --limit or shorten --duration")
        if max(excitation.apart.values()) < MIN_DISTANCE:
            reason = "separates any two rivals by one standard deviation; try a wider --limit, a longer --duration or "
            raise InputError.at(Path(text), f"{none} {reason}more outputs --measured")
        show_stage("building the FMUs", 0.0)
        remove_earlier(place, read=[source] if source else [])
        units = {q.name: q.unit for q in model.inputs}
        write_columns(place / "excitation.csv", excitation.trial.time, excitation.trial.inputs, units)
        if isinstance(question.subject, FmuSubject):
            copyfile(question.subject.structure.fmu, place / "plant.fmu")
        else:
            build(question.loaded.recipe(), place / "plant.fmu")
        rig.write(place, excitation.trial)
        write_text(place / "excitation.yaml", "\n".join(_scenario(excitation, seed)) + "\n")
        if report:
            from cosim.experiment.report import page

            with showing({"display": question.subject.display}):
                write_text(place / "report.html", page(excitation, place / "excitation.yaml"))
        return excitation


def _times(text: str, step: float, duration: float | None) -> Array:
    """Return the times of all rows [s]; for a model with long steps, the default duration is longer."""
    default, shortest, longest = (slowness(step) * seconds for seconds in (DURATION, SHORTEST, LONGEST))
    duration = default if duration is None else duration
    if not shortest <= duration <= longest:
        message = f"--duration {duration:g}: choose between {shortest:g} and {longest:g} s"
        raise InputError.at(Path(text), f"{message} for a step of {step:g} s")
    return step * np.arange(round(duration / step) + 1, dtype=np.float64)


def _choose(
    question: Question, rig: OpenLoop, time: Array, seed: int, count: int, report: Progress
) -> Excitation | None:
    """Return the best of `count` experiments, or None if all of them exceed the limits."""
    model, subject = question.loaded.model, question.subject
    usual_trial = rig.play(model, rig.usual_signals(time))
    log = usual_trial.log(model, question.measured)
    problem = build_problem(subject, [log], noise=question.noise)
    substeps = coarsen(problem).logs[0].substeps
    apart_in = partial(separation, subject, problem, substeps, question.rivals, question.pairs)
    usual = apart_in(log)
    best: Excitation | None = None

    def play_rivals(trial: Trial) -> dict[str, Trial]:
        """Return the simulation of each rival with the signals of a trial."""
        base, trials = subject.model, {}
        sensors = {k.name for k in base.sensors}  # sensor errors do not change the model
        for rival in question.rivals:
            values = {n: v for n, v in rival.values.items() if n.split(".")[0] not in sensors}
            if (other := base.with_values(values)) != model:
                trials[rival.name] = rig.play(other, trial.signals)
        return trials

    for k in range(-1, count):  # first the usual input, so that no worse input is chosen
        report("trying experiments", max(0, k) / count)
        trial, apart = usual_trial, usual
        if k >= 0:
            trial = rig.play(model, draw_signals(np.random.default_rng([seed, k]), rig.axes, time))
            if (excess := trial.excess(question.limits)) > 1.0:  # simulate again, scaled to the limits
                smaller = {name: signal * EXCURSION_SHARE / excess for name, signal in trial.signals.items()}
                trial = rig.play(model, smaller)
        if trial.excess(question.limits) > 1.0:
            continue
        if k >= 0:
            apart = apart_in(trial.log(model, question.measured))
        if best is None or merit_of(apart) > best.score:
            rivals = play_rivals(trial) if len(question.rivals) <= MAX_RIVALS else {}
            other = Excitation(question, rig, trial, rivals, apart, usual)
            best = other if best is None or other.score > best.score else best
    if best is None:
        return None
    best = replace(best, rivals=play_rivals(best.trial))
    for _ in range(SMALLER):  # until the limits are met for every rival
        if (excess := best.excess) <= 1.0:
            break
        share = EXCURSION_SHARE / excess if math.isfinite(excess) else 0.5
        report("reducing the input to the limits for all rivals", 0.0)
        trial = rig.play(model, {name: signal * share for name, signal in best.trial.signals.items()})
        best = replace(
            best, trial=trial, rivals=play_rivals(trial), apart=apart_in(trial.log(model, question.measured))
        )
    return best


# -- signals -----------------------------------------------------------------------------------


def draw_signals(rng: np.random.Generator, axes: Sequence[RigAxis], time: Array) -> dict[str, Array]:
    """Return random signals of one experiment for all axes."""
    parts = int(rng.integers(1, MAX_PARTS + 1))
    part = np.minimum((time / time[-1] * parts).astype(int), parts - 1)
    signals = {}
    for axis in axes:
        kind = str(rng.choice(INPUT_SHAPES))
        size = axis.amplitude * rng.uniform(*AMPLITUDE_SHARE)
        moves = rng.random(parts) < MOVE_PROBABILITY
        wave: Array  # within ±1
        if kind == "multisine":
            frequency = np.geomspace(axis.slowest, axis.fastest, MULTISINE_TONES)
            phase = rng.uniform(0.0, 2.0 * math.pi, MULTISINE_TONES)
            wave = np.sin(2.0 * math.pi * np.outer(time, frequency) + phase).sum(axis=1)
            wave = wave / np.abs(wave).max()
        elif kind == "chirp":
            from scipy.signal import chirp

            wave = chirp(time, axis.slowest, time[-1], axis.fastest, method="logarithmic", phi=-90)
            wave = wave if rng.random() < 0.5 else wave[::-1]
        else:
            # The signal is constant or linear for between half a period of the fastest and of the slowest frequency.
            knots, ahead = [0.0], (0.5 / axis.fastest, 0.5 / axis.slowest)
            while knots[-1] < time[-1]:
                knots.append(knots[-1] + math.exp(rng.uniform(math.log(ahead[0]), math.log(ahead[1]))))
            levels = np.concatenate([[0.0], rng.uniform(-1.0, 1.0, len(knots) - 1)])
            held = levels[np.searchsorted(knots, time, side="right") - 1]
            wave = np.interp(time, knots, levels) if kind == "ramps" else held
        signals[axis.name] = size * wave * moves[part]
    return signals


# -- files --------------------------------------------------------------------------------------


def _scenario(excitation: Excitation, seed: int) -> Iterator[str]:
    """Yield the lines of the scenario that applies the chosen input."""
    trial, question, rig = excitation.trial, excitation.question, excitation.rig
    model = question.loaded.model
    yield "name: excitation"
    yield f'description: "To separate {", ".join(r.name for r in question.rivals)}."'
    yield from (f"# {line}" for line in excitation.distances)
    yield f"duration: {trial.time[-1]:.9g}"
    yield f"step: {model.rate:.9g}"
    yield f"seed: {seed}"
    if isinstance(question.subject, FmuSubject):
        yield "algorithm: jacobi # inputs are constant between rows, also with direct feedthrough"
    yield ""
    yield "components:"
    yield "  plant: {fmu: plant.fmu}"
    yield "  excitation: {block: playback, file: excitation.csv}"
    yield from rig.components()
    yield ""
    yield "connections:"
    variances = {name: sigma**2 for name, sigma in question.noise.items()}
    yield from rig.connections(model, trial, {**model.sensor_variance, **variances})
