"""Refine, in order: study → gate → recalibrate → try every candidate → verdict → refined model → FMU → replay again.

Functions explore, the FMU proves: the error before and after is measured on replays through the FMUs, and the
validation logs are opened when everything is decided.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.files import atomic_write
from cosim.refine.attribution import Attribution, Attributor, Hypothesis, coarsened
from cosim.refine.candidates import candidates, neutral_values
from cosim.refine.fit import Problem
from cosim.refine.log import Log
from cosim.refine.measure import Evidence, Variant, noise_floor, replays, rmse
from cosim.refine.model_file import HOVERCRAFT, LoadedModel, write_model
from cosim.refine.problem import build_problem, varied_inputs
from cosim.refine.study import Study, read_study
from cosim.refine.unnamed import unnamed_terms
from cosim.refine.verdict import CI95, Verdict, judge
from cosim.version import __version__
from plant.quantities import parameters_of

if TYPE_CHECKING:
    from fmus.build import Recipe

SCHEMA_VERSION = 1
FLOOR_SEED = 20121
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Refinement:
    """What a study came to, with all that a report shows of it."""

    study: Study
    attribution: Attribution
    verdict: Verdict
    record: Mapping[str, Any]
    folder: Path
    problem: Problem
    variants: Mapping[str, Variant]
    evidence: Mapping[str, Mapping[str, Evidence]]  # before, recalibrated, after → estimation, validation


def refine(path: Path, folder: Path, progress: Progress | None = None) -> Refinement:
    """Run a study; leaves refine.json, model.yaml and plant.fmu in `folder`. Raises InputError."""
    began = time.perf_counter()
    tell = progress or (lambda stage, share: None)
    tell("reading the logs", 0.0)
    study = read_study(path)
    model = study.loaded.model
    problem = build_problem(model, study.logs, noise=study.content.noise, sensors=study.loaded.values)
    trial = candidates(model, problem.values, varied_inputs(model, study.logs))
    if study.content.candidates is not None:
        trial = [c for c in trial if c.name in study.content.candidates]
    attribution = Attributor(model, problem, trial, tell).run()
    tell("looking for what has no name", 0.0)
    nameless = build_problem(model, study.logs, unnamed=True, noise=study.content.noise, sensors=study.loaded.values)
    generated = problem.kernel.generated
    forced = [generated.states[generated.stochastic[k]] for k in generated.noisy]
    verdict = judge(attribution, unnamed_terms(coarsened(nameless), attribution.best.fit), model, forced)
    refined = refined_model(study.loaded, verdict.claimed)
    folder.mkdir(parents=True, exist_ok=True)
    write_model(folder / "model.yaml", refined)
    tell("building the refined FMU", 0.0)
    fmus = _build_fmus(study.loaded, refined, folder)
    tell("replaying through the FMUs", 0.0)
    variants = _variants(study, attribution, verdict, refined, fmus)
    parts = {part: logs for part, logs in (("estimation", study.logs), ("validation", study.unseal())) if logs}
    evidence = _replayed(variants, parts, study)
    fmus["given"].unlink()
    rng = np.random.default_rng(FLOOR_SEED)
    floor = {part: noise_floor(variants["after"], logs, rng, noise=study.content.noise) for part, logs in parts.items()}
    record = _record(study, attribution, verdict, evidence, floor, time.perf_counter() - began)
    with atomic_write(folder / "refine.json") as stream:
        json.dump(record, stream, indent=2, ensure_ascii=False, allow_nan=False)
        stream.write("\n")
    return Refinement(study, attribution, verdict, record, folder, problem, variants, evidence)


def refined_model(loaded: LoadedModel, claimed: Hypothesis | None) -> LoadedModel:
    """The model with what was claimed put in, base parameters recalibrated with it; unchanged where nothing was."""
    if claimed is None:
        return loaded
    sensors = {f"{k.name}.{p.name}" for k in loaded.model.sensors for p in parameters_of(k)}
    moved = {f.name: float(claimed.fit.values[f.name]) for f in claimed.fit.free}
    parameters = {**loaded.parameters, **{n: v for n, v in moved.items() if n not in sensors}}
    known = {**loaded.sensors, **{n: v for n, v in moved.items() if n in sensors}}
    return LoadedModel(loaded.model.with_values(parameters), loaded.source, parameters, known)


def _build_fmus(loaded: LoadedModel, refined: LoadedModel, folder: Path) -> dict[str, Path]:
    """FMUs of the model named in the study and of the refined one."""
    from fmus.build import build

    given = build(recipe_of(loaded), folder / ".given.fmu")
    return {"given": given, "refined": build(recipe_of(refined), folder / "plant.fmu")}


def recipe_of(loaded: LoadedModel) -> Recipe:
    """What makes the FMU of a model."""
    from fmus.build import model_recipe, plant_recipe

    if loaded.source == HOVERCRAFT:
        return plant_recipe(dict(loaded.parameters))
    return model_recipe(loaded.model, Path(loaded.source.rpartition(":")[0]), dict(loaded.parameters))


def _variants(
    study: Study, a: Attribution, verdict: Verdict, refined: LoadedModel, fmus: Mapping[str, Path]
) -> dict[str, Variant]:
    """The model before, recalibrated and after, each with the filter that starts its replays."""
    given, base = study.loaded, a.base.fit
    nominal = {**neutral_values(given.model), **given.values}
    recalibrated = {f.name: float(base.values[f.name]) for f in base.free}
    changed = given.model.with_values(recalibrated)
    claimed = verdict.claimed
    values, log_q = (nominal, base.log_q) if claimed is None else ({**nominal, **claimed.fit.values}, claimed.fit.log_q)
    return {
        "before": Variant(given.model, nominal, base.log_q, fmus["given"], {}),
        "recalibrated": Variant(changed, {**nominal, **recalibrated}, base.log_q, fmus["given"], recalibrated),
        "after": Variant(refined.model, values, log_q, fmus["refined"], {}),
    }


def _replayed(
    variants: Mapping[str, Variant], parts: Mapping[str, Sequence[Log]], study: Study
) -> dict[str, dict[str, Evidence]]:
    """Replays of every variant on the estimation and the validation logs."""
    found: dict[str, dict[str, Evidence]] = {}
    for name, variant in variants.items():
        found[name] = {}
        for part, logs in parts.items():
            problem = build_problem(variant.model, logs, noise=study.content.noise)
            found[name][part] = replays(variant, problem, logs)
    return found


def _record(
    study: Study,
    a: Attribution,
    verdict: Verdict,
    evidence: Mapping[str, Mapping[str, Evidence]],
    floor: Mapping[str, Any],
    seconds: float,
) -> dict[str, Any]:
    """What refine.json holds."""
    return {
        "schema_version": SCHEMA_VERSION,
        "cosim_version": __version__,
        "study": str(study.path),
        "verdict": verdict.name,
        "sentence": verdict.sentence,
        "effects": [] if verdict.claimed is None else _effects(study, verdict.claimed, a),
        "rivals": list(verdict.rivals) if verdict.name == "ambiguous" else [],
        "experiment": verdict.experiment,
        "nearest": list(verdict.rivals) if verdict.name == "unexplained" else [],
        "candidates": _ranking(a),
        "residual": verdict.residual,
        "horizon": study.loaded.model.horizon if np.isfinite(study.loaded.model.horizon) else "free run",
        "error": {name: {part: _known(rmse(e)) for part, e in parts.items()} for name, parts in evidence.items()},
        "noise_floor": _known(floor.get("validation") or floor["estimation"]),
        "noise_floors": {part: _known(channels) for part, channels in floor.items()},
        "held_out_gain": a.held_out,
        "seconds": seconds,
    }


def _known(channels: Mapping[str, float]) -> dict[str, float]:
    """Figures of the channels that were predicted at all: a log too short for one replay gives none."""
    return {name: value for name, value in channels.items() if np.isfinite(value)}


def _effects(study: Study, claimed: Hypothesis, a: Attribution) -> list[dict[str, Any]]:
    """What was added, most important first: that whose loss alone would cost most."""
    model = study.loaded.model
    units = {f"{k.name}.{p.name}": p.unit for k in (*model.catalogue, *model.sensors) for p in parameters_of(k)}
    units |= {p.name: p.unit for p in model.parameters}
    alone = {h.names: h.score for h in a.tried if len(h.candidates) == 1}
    ordered = sorted(claimed.candidates, key=lambda c: alone.get((c.name,), np.inf))
    return [
        {
            "name": c.name,
            "parameters": {
                n.partition(".")[2] or "value": {
                    "value": float(claimed.fit.values[n]),
                    "unit": units[n],
                    "ci95": [float(claimed.fit.values[n] + s * CI95 * claimed.fit.sigma(n)) for s in (-1, 1)],
                }
                for n in c.parameters
            },
        }
        for c in ordered
    ]


def _ranking(a: Attribution) -> list[dict[str, Any]]:
    """Every hypothesis tried, best first, with its scores and why it lost."""
    rows = []
    for h in a.tried:
        rows.append(
            {
                "names": list(h.names),
                "log_likelihood_gain": a.base.fit.nll - h.fit.nll,
                "score_gain": a.base.score - h.score,
                "parameters": {n: float(h.fit.values[n]) for c in h.candidates for n in c.parameters},
                "why": a.reasons.get(h.names[0], "")
                if len(h.names) == 1
                else "claimed"
                if h is a.best
                else "explains less",
            }
        )
    return rows
