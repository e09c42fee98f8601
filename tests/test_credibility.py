"""An FMU that knows where it is valid and how wrong it is there: bands, region, record, runs, identity."""

from __future__ import annotations

import json
import math
import shutil
import zipfile
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import fmpy
import jsonschema
import numpy as np
import pytest
import xmlschema

import cosim
from cosim.core.errors import InputError
from cosim.credibility.bands import Track, band_horizons, bands_of, conformal_quantile, coverage_of
from cosim.credibility.found import IDENTITY, RECORD, read_credibility
from cosim.credibility.record import SRMD, attach, sign
from cosim.credibility.region import Stretch, distances, region_of
from cosim.verbs.checks import schema_of
from tests.cases import some
from tests.logs import write_log
from tests.slider import slider_bench, slider_fmu, slider_log
from tests.test_first_steps import told

SCHEMAS = Path(__file__).parent / "data" / "ssp_traceability"

# -- bands --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [9, 10, 19, 57])
def test_blocks_of_one_row_give_the_order_statistic_of_split_conformal_prediction(count: int) -> None:
    sizes = np.random.default_rng(count).exponential(size=count)
    rank = math.ceil((count + 1) * 0.9)
    assert conformal_quantile([np.array([v]) for v in sizes], 0.9) == np.sort(sizes)[rank - 1]


def test_fewer_blocks_than_the_level_needs_bound_nothing() -> None:
    assert conformal_quantile([np.array([v]) for v in range(8)], 0.9) == math.inf
    assert conformal_quantile([], 0.9) == math.inf


def test_rows_of_a_further_block_are_covered_as_often_as_stated_whatever_their_distribution() -> None:
    """Blocks differ in size and number of rows, and the rows of a block are alike: 2000 draws scatter by 0.5 %."""
    rng, blocks, shares = np.random.default_rng(1), 30, []
    for _ in range(2000):
        drawn = [
            rng.lognormal(sigma=1.5) * np.abs(rng.standard_t(3, size=rng.integers(3, 40))) for _ in range(blocks + 1)
        ]
        shares.append(np.mean(drawn[-1] <= conformal_quantile(drawn[:-1], 0.9)))
    assert 0.9 - 0.015 < np.mean(shares) < 0.9 + 1.0 / (blocks + 1) + 0.015


def random_walks(seed: int, logs: int, horizon: float) -> list[Track]:
    """Errors of replays of 1 s … that grow like those of an integrator, with a row every 0.1 s."""
    rng, rows = np.random.default_rng(seed), round(horizon / 0.1)
    ages = np.tile(0.1 * np.arange(1, rows + 1), 12)
    walks = [np.concatenate([np.cumsum(rng.standard_normal(rows)) for _ in range(12)]) for _ in range(logs)]
    return [Track({"x": walk}, ages, np.repeat(np.arange(12), rows)) for walk in walks]


def test_bands_grow_with_the_horizon_and_cover_sealed_logs() -> None:
    horizons = [1.0, 2.0, 4.0]
    bands = bands_of({h: random_walks(7, 6, h) for h in horizons}, {"x": "m"}, held_out=True, free=False)
    widths = bands.widths["x"]
    assert bands.replays == [72, 72, 72]
    assert widths == sorted(widths)
    # √age steps; the last half of an interval has ages of 3/4 of its end
    expected = [1.645 * math.sqrt(7.5 * h) for h in horizons]
    assert widths == pytest.approx(expected, rel=0.3)
    covered = coverage_of(bands, {h: random_walks(8, 40, h) for h in horizons})
    assert covered is not None
    assert 0.85 < covered.outputs["x"] < 0.95
    assert np.isnan(bands.at("x", np.array([4.1, np.nan]))).all()


@pytest.mark.parametrize(
    ("durations", "first", "longest"), [([198.0, 198.0], 5.0, 39.6), ([38.0] * 3, 0.5, 9.5), ([4.0], 0.5, 0.0)]
)
def test_the_longest_horizon_has_enough_replays(durations: list[float], first: float, longest: float) -> None:
    horizons = band_horizons(durations, first)
    assert (horizons[-1] if horizons else 0.0) == pytest.approx(longest, rel=2e-3)
    assert all(b / a < 2.001 for a, b in pairwise(horizons))


# -- region -------------------------------------------------------------------------------------------


def motion(seed: int, size: float = 1.0, rows: int = 1500) -> Stretch:
    """A lightly damped mass under random force, and an input that nobody moves."""
    rng, y, v = np.random.default_rng(seed), np.zeros(rows), np.zeros(rows)
    u = size * np.repeat(rng.uniform(-1, 1, rows // 50 + 1), 50)[:rows]
    for k in range(rows - 1):
        v[k + 1] = v[k] + 0.02 * (u[k] - y[k] - 0.5 * v[k])
        y[k + 1] = y[k] + 0.02 * v[k + 1]
    return Stretch(0.02 * np.arange(rows), {"u": u, "gravity": np.full(rows, 9.81), "y": y, "v": v})


@pytest.fixture(scope="module")
def region() -> Any:
    return region_of([motion(seed) for seed in (1, 2)], ["u", "gravity"], {"y": "m"}, 0.02)


def test_new_motion_of_the_same_kind_stays_inside_and_larger_motion_leaves(region: Any) -> None:
    inside = [[distances(region, motion(s, size)).inside.mean() for s in range(10, 18)] for size in (1.0, 2.0, 4.0)]
    assert np.mean(inside[0]) > 0.94  # 95 % are aimed at
    assert np.mean(inside[1]) < 0.6
    assert np.mean(inside[2]) < 0.2
    assert (
        region.left_out == {"rate of gravity": "constant", "rate of y": "repeats v"} or "rate of y" in region.left_out
    )


def test_a_constant_input_leaves_the_region_as_soon_as_it_moves(region: Any) -> None:
    moved = motion(3)
    moved.signals["gravity"][700:] = 9.7
    away = distances(region, moved)
    assert region.constant == ["gravity"]
    assert away.inside[:700].mean() > 0.9
    assert not away.inside[700:].any()
    assert region.coordinates[away.farthest[900]].name == "gravity"


def test_the_distance_does_not_depend_on_the_step_of_the_run(region: Any) -> None:
    whole = motion(5)
    fine = np.linspace(0.0, whole.time[-1], 4 * whole.time.size - 3)
    held = {
        n: v[np.minimum(np.arange(fine.size) // 4, v.size - 1)] for n, v in whole.signals.items() if n in "u gravity"
    }
    smooth = {n: np.interp(fine, whole.time, v) for n, v in whole.signals.items() if n in "yv"}
    one, other = distances(region, whole), distances(region, Stretch(fine, held | smooth))
    assert other.time == pytest.approx(one.time)
    assert np.median(np.abs(one.ratio - other.ratio)) < 0.02


def test_a_short_log_has_no_region() -> None:
    assert "too few data" in region_of([motion(1, rows=100)], ["u", "gravity"], {}, 0.02).reason


# -- a fitted FMU and its record -----------------------------------------------------------------------

QUICK: dict[str, Any] = {"in_process": True, "report": False}
VARY: dict[str, Any] = {"vary": ["mass", "damping"], "start": {"gain": 2.0}}


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs of a slider, its FMU, and the FMU fitted to two logs in `out`; the third log is sealed."""
    folder = slider_bench(tmp_path_factory.mktemp("credible"))
    logs = [folder / "a.csv", folder / "b.csv"]
    cosim.fit(logs, folder / "slider.fmu", out=folder / "out", sealed=[folder / "c.csv"], **VARY, **QUICK)
    return folder


@pytest.fixture
def fmu(bench: Path, tmp_path: Path) -> Path:
    """A copy of the fitted FMU."""
    return Path(shutil.copy(bench / "out" / "fitted.fmu", tmp_path / "slider.fmu"))


def content(fmu: Path, name: str = RECORD) -> Any:
    with zipfile.ZipFile(fmu) as archive:
        return json.loads(archive.read(name))


def replace_member(fmu: Path, name: str, data: bytes) -> None:
    with zipfile.ZipFile(fmu) as old:
        members = {n: old.read(n) for n in old.namelist()}
    with zipfile.ZipFile(fmu, "w") as new:
        for member, before in members.items():
            new.writestr(member, data if member == name else before)


def test_the_record_has_logs_region_bands_parameters_and_keeps_its_schema(bench: Path, fmu: Path) -> None:
    record = content(fmu)
    jsonschema.validate(record, schema_of("credibility"))
    assert [Path(log["source"]).name for log in record["logs"]] == ["a.csv", "b.csv"]
    assert [Path(log["source"]).name for log in record["sealed"]] == ["c.csv"]
    assert {len(log["sha256"]) for log in record["logs"]} == {64}
    assert {c["signal"] for c in record["region"]["coordinates"]} == {"force", "velocity"}  # no level of a position
    assert record["bands"]["held_out"]
    assert record["bands"]["widths"]["velocity"][0] == pytest.approx(1.645 * 0.01, rel=0.25)  # noise of the log
    low, high = record["parameters"]["mass"]["ci95"]
    assert low < 1.6 < high
    assert record["correlations"]["names"] == ["mass", "damping"]
    answer = json.loads((bench / "out" / "fit.json").read_text(encoding="utf-8"))
    assert answer["coverage"]["inside"] > 0.9
    assert all(0.85 < share < 0.99 for share in answer["coverage"]["outputs"].values())


def test_the_same_is_in_metadata_for_ssp(fmu: Path) -> None:
    """Valid by the schemas of SSP LS Traceability 1.0-rc.2, which import those of SSP and xlink."""
    with zipfile.ZipFile(fmu) as archive:
        text = archive.read(SRMD).decode()
    xlink = Path(xmlschema.__file__).parent / "schemas" / "XLINK" / "xlink.xsd"
    places = {"http://www.w3.org/1999/xlink": str(xlink)}
    schema = xmlschema.XMLSchema11(SCHEMAS / "SRMD.xsd", locations=places, allow="local")
    schema.validate(text)
    with pytest.raises(xmlschema.XMLSchemaValidationError):
        schema.validate(text.replace('version="1.0.0"', ""))
    root = ElementTree.fromstring(text)
    (group,) = root
    texts = {entry.get("keyword"): entry.text for entry in group}
    assert content(fmu)["logs"][0]["sha256"] in str(texts["log 1"])
    assert (Path(SRMD).parent / group.attrib["{http://www.w3.org/1999/xlink}href"]).parts[-2:] == Path(RECORD).parts[1:]


def test_info_shows_it_and_draws_it(fmu: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shown = told("info", fmu, "--report")
    for word in ("credibility", "mass = 1.6", "force", "velocity: ±"):
        assert word in shown
    page = (tmp_path / "slider-credibility.html").read_text(encoding="utf-8")
    assert "Error of velocity" in page
    assert content(fmu)["logs"][0]["sha256"] in page
    assert json.loads(told("info", fmu, "--json"))["credibility"]["verdict"] == "improved"


def test_an_fmu_without_a_record_has_no_page(bench: Path) -> None:
    assert "has no record" in told("info", bench / "slider.fmu", "--report", code=2)


# -- runs ------------------------------------------------------------------------------------------------


def mission(folder: Path, fmu: Path, sizes: list[float], criteria: str = "") -> Path:
    """A scenario whose force has another size every 5 s."""
    time = 0.05 * np.arange(100 * len(sizes) + 1)
    rng = np.random.default_rng(9)
    force = np.repeat(sizes, 100) * np.repeat(rng.uniform(-1.0, 1.0, 5 * len(sizes)), 20)
    write_log(folder / "force.csv", {"time": time, "force": np.append(force, force[-1:])})
    scenario = folder / "mission.yaml"
    scenario.write_text(
        f"name: mission\nduration: {5 * len(sizes)}\nstep: 0.05\ncomponents:\n"
        f"  plant: {{fmu: {fmu}}}\n  played: {{block: playback, file: force.csv}}\n"
        f"connections: [{{from: played.force, to: plant.force}}]\n{criteria}"
    )
    return scenario


GOAL = "criteria: {valid: {of: plant, min: 0.95}}\n"


def test_a_run_says_when_it_leaves_the_logs_and_a_criterion_judges_it(fmu: Path, tmp_path: Path) -> None:
    scenario, out = mission(tmp_path, fmu, [0.5, 0.5, 5.0], GOAL), tmp_path / "out"
    told("run", scenario, "--out", out, code=5)
    manifest = json.loads((out / "manifest.json").read_text(encoding="utf-8"))
    entry = manifest["validity"]["plant"]
    assert 0.65 < entry["share"] < 0.85
    assert entry["outside"] == [[11.0, 15.0]]
    assert manifest["criteria"] == [
        {"kind": "time_outside_logs", "of": "plant", "value": pytest.approx(26.7, abs=0.1), "max": pytest.approx(5.0),
         "unit": "%", "met": False}
    ]  # fmt: skip
    page = (out / "report.html").read_text(encoding="utf-8")
    assert '"outside":[[' in page
    assert "plant.velocity" in page
    assert told("report", out)
    assert (out / "report.html").read_text(encoding="utf-8").count('"outside":[[') == page.count('"outside":[[')


def test_a_run_within_the_logs_meets_it(fmu: Path, tmp_path: Path) -> None:
    made = cosim.run(mission(tmp_path, fmu, [0.5, 0.5], GOAL), in_process=True)
    assert not made.missed
    assert made.manifest["validity"]["plant"]["share"] > 0.95
    assert "valid for" in repr(made)


@pytest.mark.parametrize(
    ("criteria", "place"),
    [
        ("criteria: {valid: {of: plont, min: 0.9}}\n", ":8:26"),
        ("criteria: {valid: {of: played, min: 0.9}}\n", ":8:24"),
        ("criteria: {valid: {of: plant, min: 1.5}}\n", ":8:36"),
        ("criteria: {valid: {of: plant.velocity, max: 1}}\n", ":8:"),
        ("criteria: {peak: {of: plant, min: 0.5}}\n", ":8:"),
    ],
)
def test_a_wrong_criterion_is_refused_at_its_place(fmu: Path, tmp_path: Path, criteria: str, place: str) -> None:
    with pytest.raises(InputError) as refused:
        cosim.check(mission(tmp_path, fmu, [1.0], criteria), load=False)
    assert any(f.line == 8 for f in refused.value.faults), place


@pytest.mark.parametrize("recorded", ["played.force", "plant.force"])
def test_what_is_not_recorded_meets_no_criterion(fmu: Path, tmp_path: Path, recorded: str) -> None:
    scenario, out = mission(tmp_path, fmu, [0.5], GOAL), tmp_path / "out"
    told("run", scenario, "--set", f"record={{signals: [{recorded}]}}", "--out", out, code=5)
    manifest = json.loads((out / "manifest.json").read_text(encoding="utf-8"))
    assert "rate of velocity" in manifest["validity"]["plant"]["missing"]
    assert [(c["value"], c["met"]) for c in manifest["criteria"]] == [(None, False)]


@pytest.mark.parametrize(
    ("key", "changes"),
    [("region", {"points": []}), ("region", {"points": [[0.0]]}), ("bands", {"widths": {"velocity": [1.0]}})],
)
def test_a_record_that_does_not_fit_itself_is_ignored(fmu: Path, tmp_path: Path, key: str, changes: Any) -> None:
    record = content(fmu)
    record[key] |= changes
    replace_member(fmu, RECORD, json.dumps(record).encode())
    assert read_credibility(fmu).record is None
    manifest = cosim.run(mission(tmp_path, fmu, [0.5]), tmp_path / "out", **QUICK).manifest
    assert "problem" in manifest["validity"]["plant"]


def test_sweep_simulate_replay_and_compare_say_it_too(fmu: Path, bench: Path, tmp_path: Path) -> None:
    scenario = mission(tmp_path, fmu, [0.5], GOAL)
    (tmp_path / "sweep.yaml").write_text(
        f"scenario: {scenario}\nvary: {{components.plant.start.mass: {{values: [1.6, 0.1]}}}}\n"
    )
    swept = json.loads(told("sweep", tmp_path / "sweep.yaml", "--out", tmp_path / "swept", "--json", "--workers", "1"))
    (goal,) = swept["criteria"]
    assert (goal["met"], goal["of"]) == (1, 2)
    low, high = swept["valid"]["plant"]
    assert low < 0.8 < 0.9 < high
    made = cosim.simulate(fmu, set={"force": 30.0}, stop=5.0, in_process=True)
    assert made.manifest["validity"]["slider"]["share"] < 0.1
    replayed = cosim.replay(bench / "c.csv", fmu=fmu, out=tmp_path / "replayed", **QUICK)
    assert replayed.validity["share"] > 0.9
    assert json.loads((tmp_path / "replayed" / "replay.json").read_text())["validity"]["share"] > 0.9
    runs = [
        cosim.run(scenario, tmp_path / f"run{k}", {"components.plant.start.mass": m}, **QUICK)
        for k, m in ((1, 1.6), (2, 1.0))
    ]
    (cell,) = cosim.compare(*runs).table["plant.velocity"][1:]
    assert cell is not None
    assert "beyond the error band" in cell.note


# -- other hosts, other kinds of FMUs ----------------------------------------------------------------------


@pytest.mark.parametrize(("version", "exchange"), some([(2, False), (2, True), (3, False), (3, True)], every=1))
def test_every_kind_of_fmu_carries_it_and_other_hosts_see_a_usual_fmu(
    fmu: Path, tmp_path: Path, version: int, exchange: bool
) -> None:
    plain = slider_fmu(tmp_path / "plain.fmu", version, exchange=exchange)
    known = Path(shutil.copy(plain, tmp_path / "known.fmu"))
    record = read_credibility(fmu).record
    assert record is not None
    attach(known, record)
    results = [
        fmpy.simulate_fmu(str(path), stop_time=2.0, output=["velocity"], validate=False) for path in (plain, known)
    ]
    assert np.array_equal(*results)
    assert fmpy.validation.validate_fmu(str(known)) == fmpy.validation.validate_fmu(str(plain))
    made = cosim.simulate(known, set={"force": 30.0}, stop=2.0, in_process=True)
    assert made.manifest["validity"]["known"]["share"] < 0.2
    assert not [w for w in made.warnings if "SHA-256" in w]
    with zipfile.ZipFile(plain) as old, zipfile.ZipFile(known) as new:
        assert all(new.read(name) == old.read(name) for name in old.namelist())


# -- bad input ---------------------------------------------------------------------------------------------


def test_a_changed_file_is_found(fmu: Path, tmp_path: Path) -> None:
    replace_member(fmu, "documentation/license.txt", b"mine")
    assert "SHA-256" in "".join(cosim.check(fmu, load=False))
    made = cosim.run(mission(tmp_path, fmu, [1.0]), in_process=True)
    assert any("SHA-256" in warning for warning in made.warnings)
    assert made.manifest["validity"]["plant"]["share"] is not None


@pytest.mark.parametrize(
    ("data", "word"), [(b'{"schema_version": 2}', "schema 2"), (b"{", "damaged"), (b'{"schema_version": 1}', "damaged")]
)
def test_a_newer_or_damaged_record_is_told_and_ignored(fmu: Path, tmp_path: Path, data: bytes, word: str) -> None:
    replace_member(fmu, RECORD, data)
    assert word in "".join(cosim.check(fmu, load=False))
    made = cosim.run(mission(tmp_path, fmu, [1.0]), in_process=True)
    assert any(word in warning for warning in made.warnings)


def test_one_short_log_has_too_few_data_for_bands(bench: Path, tmp_path: Path) -> None:
    log = slider_log(tmp_path / "short.csv", seconds=5.0)
    cosim.fit([log], bench / "slider.fmu", out=tmp_path / "out", **VARY, **QUICK)
    record = content(tmp_path / "out" / "fitted.fmu")
    assert "too few data" in record["bands"]["reason"]
    assert not record["bands"]["held_out"]
    made = cosim.run(mission(tmp_path, tmp_path / "out" / "fitted.fmu", [1.0]), in_process=True)
    assert made.manifest["validity"]["plant"]["bands"]["widths"] == {}


# -- signature ---------------------------------------------------------------------------------------------


@pytest.mark.skipif(find_spec("cryptography") is None, reason="cryptography is not installed: fmu-cosim[sign]")
def test_a_signature_holds_until_the_fmu_is_changed(fmu: Path, tmp_path: Path) -> None:
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    private, public = tmp_path / "key.pem", tmp_path / "key.pub"
    key, form = Ed25519PrivateKey.generate(), serialization.Encoding.PEM
    private.write_bytes(key.private_bytes(form, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()))
    public.write_bytes(key.public_key().public_bytes(form, serialization.PublicFormat.SubjectPublicKeyInfo))
    assert "is not signed" in told("check", fmu, "--no-load", "--signed-by", public, code=2)
    sign(fmu, private)
    told("check", fmu, "--no-load", "--signed-by", public)
    replace_member(fmu, "documentation/license.txt", b"mine")
    assert "signed" in told("check", fmu, "--no-load", "--signed-by", public, code=2)


@pytest.mark.skipif(find_spec("cryptography") is not None, reason="cryptography is installed")
def test_without_cryptography_a_signature_names_what_to_install(fmu: Path, tmp_path: Path) -> None:
    (tmp_path / "key.pub").write_text("")
    assert "fmu-cosim[sign]" in told("check", fmu, "--no-load", "--signed-by", tmp_path / "key.pub", code=2)


def test_the_identity_is_the_hash_of_all_other_files(fmu: Path) -> None:
    before = content(fmu, IDENTITY)["sha256"]
    replace_member(fmu, IDENTITY, b"{}")
    assert read_credibility(fmu).problem
    record = read_credibility(fmu).record
    assert record is not None
    attach(fmu, record)
    assert content(fmu, IDENTITY)["sha256"] == before
