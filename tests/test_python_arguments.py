"""Every function of `cosim` with odd values for every argument: it works, or says what is wrong as a CosimError."""

from __future__ import annotations

import datetime
import enum
import inspect
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cosim
from cosim.core.errors import CosimError, InputError
from tests.typed import typed_fmu


class Gear(enum.IntEnum):
    """A number of Python that is no plain int."""

    FIRST = 1


def nested(levels: int) -> dict[str, Any]:
    value: dict[str, Any] = {}
    for _ in range(levels):
        value = {"a": value}
    return value


def within_itself() -> list[Any]:
    value: list[Any] = ["a"]
    value.append(value)
    return value


ODD: dict[str, Any] = {
    "None": None, "True": True, "bool_": np.bool_(True), "-1": -1, "1.5": 1.5, "int64": np.int64(2),
    "float32": np.float32(1.5), "0-d": np.array(3), "array": np.array([1.0, 2.0]),
    "objects": np.array([None, {}], dtype=object), "nan": float("nan"), "inf": -np.inf, "huge": 10**400,
    "huger": 10**5000, "decimal": Decimal("0.1"), "complex": 1j, "enum": Gear.FIRST, "bytes": b"a",
    "str_": np.str_("a"), "empty": "", "blank": " ", "nul": "a\0b", "half": "a\ud800", "newline": "a\nb",
    "longer": "x/" * 5000, "number": "2", "furlong": "4 furlong", "dash": "--out", "root": "/", "dot": ".",
    "path": Path("x"), "nul path": Path("a\0b"), "list": [], "ints": [1], "mixed": ["a", b"b"],
    "names": ["a", "b=1"], "tuple": ("a",), "set": {"a"}, "mapping": {}, "numpy in it": {"a": np.int64(2)},
    "no text as key": {1: 2}, "nan in it": {"a": float("nan")}, "half in it": {"a\ud800": "\ud800"},
    "huge in it": {"a": 10**400}, "deep": nested(3000), "cycle": within_itself(), "object": object(), "type": int,
    "generator": (c for c in "ab"), "slice": slice(1), "date": datetime.date(2020, 1, 1),
}  # fmt: skip


@pytest.fixture(scope="module")
def material(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an FMU, a scenario, a log and a run."""
    folder = tmp_path_factory.mktemp("odd")
    typed_fmu(folder)
    (folder / "s.yaml").write_text(
        "name: s\nduration: 0.5\nstep: 0.1\ncomponents: {a: {fmu: typed.fmu, start: {r_in: 2}}}\n"
    )
    rows = "".join(f"{k / 50},{k % 7},0,1,0,{k % 7}\n" for k in range(300))
    (folder / "log.csv").write_text(f"time,r_in,i_in,e_in,b_in,r_out\n{rows}")
    (folder / "in.csv").write_text("time,r_in\n0,1\n1,2\n")
    cosim.run(folder / "s.yaml", folder / "run", in_process=True, report=False)
    return folder


def good(function: str, folder: Path) -> dict[str, Any]:
    """Arguments with which a function works, or ends soon."""
    fmu, missing = folder / "typed.fmu", folder / "missing.yaml"
    quick = {"in_process": True, "report": False, "force": True}
    return {
        "run": {"scenario": folder / "s.yaml", **quick},
        "simulate": {"fmu": fmu, "stop": 0.2, "step": 0.1, **quick},
        "replay": {"log": folder / "log.csv", "fmu": fmu, **quick},
        "fit": {"logs": [missing], "fmu": missing, "out": "out", **quick},
        "refine": {"study": missing, "out": "out", **quick},
        "check": {"files": folder / "s.yaml", "load": False},
        "compare": {"a": folder / "run", "b": folder / "run"},
        "read": {"folder": folder / "run"},
        "build": {"folder": "built", "model": str(missing)},
        "excite": {"text": str(missing), "folder": "out"},
        "identify": {"path": missing, "out": "out"},
        "linearize": {"model": missing},
        "consistency": {"runs": 2, "steps": 10**12},
        "export_ssp": {"scenario": folder / "s.yaml", "path": "s.ssp"},
        "sweep": {"path": missing, "out": "out"},
    }[function]


def cases() -> list[tuple[str, str]]:
    """Return each argument of each function, with the first function that has one of its name and type."""
    found: dict[tuple[str, str], tuple[str, str]] = {}
    for function in cosim.__all__:
        for name, parameter in inspect.signature(getattr(cosim, function)).parameters.items():
            found.setdefault((name, str(parameter.annotation)), (function, name))
    return [*found.values()]


@pytest.mark.parametrize(("function", "name"), cases())
def test_an_odd_value_of_an_argument_is_taken_or_refused_in_words(
    function: str, name: str, material: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    call: Callable[..., Any] = getattr(cosim, function)
    wrong = []
    for label, value in ODD.items():
        if (name, label) in {("out", "root"), ("folder", "root"), ("progress", "type")}:  # an error of its own
            continue
        try:
            call(**{**good(function, material), name: value})
        except CosimError:
            pass
        except Exception as error:
            wrong.append(f"{label}: {type(error).__name__}: {str(error)[:200]}")
    assert wrong == []


@pytest.mark.parametrize("value", [np.int64(2), np.float32(2), np.array(2), Gear.FIRST])
def test_a_number_of_numpy_is_a_number_for_run_and_simulate_alike(material: Path, value: Any) -> None:
    single = cosim.simulate(material / "typed.fmu", set={"r_in": value}, stop=0.2, step=0.1, in_process=True)
    run = cosim.run(material / "s.yaml", set={"components.a.start.r_in": value}, in_process=True)
    assert single["typed.r_in"][0] == run["a.r_in"][0] == float(value)


def test_every_argument_that_does_not_fit_is_named_at_once(material: Path) -> None:
    with pytest.raises(InputError) as refused:
        cosim.simulate(material / "typed.fmu", "a\0b", {"r_in": Decimal(1)}, stop=10**400, step="4 furlong", report=2)
    assert [str(f).partition(":")[0] for f in refused.value.faults] == ["out", "report", "set", "step", "stop"]
