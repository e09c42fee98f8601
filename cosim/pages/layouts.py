"""Named layouts of the signal browser, stored in one JSON file."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, FiniteFloat, ValidationError

from cosim.core.errors import InputError
from cosim.files.files import open_bytes, parse_json, write_json

MAX_LAYOUT_NAME_CHARACTERS = 80  # characters of a name
MOST_AXES = 4  # of a plot
MAX_LAYOUTS_BYTES = 1 << 26  # of a file
LayoutName = Annotated[str, Field(min_length=1, max_length=MAX_LAYOUT_NAME_CHARACTERS, pattern=r"\S")]


class SignalPlace(BaseModel):
    """A signal of a run, by the name of the run."""

    run: str
    name: str


class Curve(SignalPlace):
    """A curve: a signal with the number of its colour."""

    colour: int = Field(0, ge=0)
    hidden: bool = False


class Axis(BaseModel):
    """An axis with its curves; without a range, it is scaled to the values."""

    range: tuple[FiniteFloat, FiniteFloat] | None = None
    curves: list[Curve]


class Plot(BaseModel):
    """A plot over time, or over another signal."""

    kind: Literal["time", "xy", "spectrum"] = "time"
    height: int | None = None  # [px]
    across: SignalPlace | None = None
    axes: list[Axis] = Field(max_length=MOST_AXES)


class DerivedSignal(BaseModel):
    """A derived signal of the run of its first letter."""

    name: str
    formula: str
    unit: str = ""
    of: dict[str, SignalPlace] = Field(min_length=1)


class View(BaseModel):
    """The visible time range [s]."""

    begin: FiniteFloat = Field(alias="from")
    end: FiniteFloat = Field(alias="to")


class Layout(BaseModel):
    """Plots, range of time and derived signals."""

    plots: list[Plot]
    view: View | None = None
    columns: int = Field(1, ge=1, le=3)
    derived: list[DerivedSignal] = []


class LayoutFile(BaseModel):
    """Layouts by name; unknown keys of other versions are ignored."""

    schema_version: Literal[1]
    layouts: dict[LayoutName, Layout]


def check_layouts(file: Path, content: Any) -> dict[str, Any]:
    """Return the layouts of a file's content; raise InputError with the place of the first fault."""
    try:
        LayoutFile.model_validate(content)
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in fault["loc"] if part != "[key]")
        cure = "give another --layout, or save the layout again on the page"
        raise InputError.at(file, f"is not a layout file of `cosim view`: {place}: {fault['msg']}; {cure}") from None
    layouts: dict[str, Any] = content["layouts"]
    return layouts


class Layouts:
    """Layouts in a file, which is checked at the start and rewritten whole at each change.

    Raises:
        InputError: The file exists, but is not a valid file of layouts.
    """

    def __init__(self, file: Path) -> None:
        self.file, self._lock = file, threading.Lock()
        self.read()

    def read(self) -> dict[str, Any]:
        """Return name → layout."""
        try:
            with open_bytes(self.file) as stream:
                content = parse_json(stream.read(MAX_LAYOUTS_BYTES))
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, RecursionError):
            content = None
        return check_layouts(self.file, content)

    def put(self, name: Any, layout: Any) -> dict[str, Any]:
        """Save a layout under a name, or remove it if `layout` is None; return all layouts."""
        with self._lock:
            layouts = {key: value for key, value in self.read().items() if key != name}
            if layout is not None:
                layouts[name] = layout
            content = {"schema_version": 1, "layouts": layouts}
            check_layouts(self.file, content)
            try:
                self.file.parent.mkdir(parents=True, exist_ok=True)
                write_json(self.file, content)
            except OSError as error:
                cure = "download the layout, or give another --layout"
                raise InputError.at(self.file, f"cannot be written: {error.strerror}; {cure}") from None
        return layouts
