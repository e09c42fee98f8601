"""Layouts of the page by name, in one JSON file."""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cosim.base.errors import InputError
from cosim.storage.files import write_json
from cosim.viewing import messages

SCHEMA_VERSION = 1
LONGEST = 80  # characters of a name


class Layouts:
    """Layouts in a file, which is read at the start and written as a whole.

    Raises:
        InputError: The file is there and holds no layouts.
    """

    def __init__(self, file: Path) -> None:
        self.file, self._lock = file, threading.Lock()
        self.read()

    def read(self) -> dict[str, Any]:
        """Return name → layout."""
        try:
            content = json.loads(self.file.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, RecursionError):
            content = None
        layouts = content.get("layouts") if isinstance(content, dict) else None
        if not isinstance(layouts, dict) or content.get("schema_version") != SCHEMA_VERSION:
            raise InputError.at(self.file, messages.WRONG_LAYOUTS())
        return layouts

    def put(self, name: Any, layout: Any) -> dict[str, Any]:
        """Save a layout under a name, or remove it if it is None; return all."""
        if not isinstance(name, str) or not name.strip() or len(name) > LONGEST:
            raise InputError.at(self.file, messages.WRONG_REQUEST(reason="a layout has a short name"))
        if layout is not None and not isinstance(layout, Mapping):
            raise InputError.at(self.file, messages.WRONG_REQUEST(reason="a layout is an object"))
        with self._lock:
            layouts = {key: value for key, value in self.read().items() if key != name}
            if layout is not None:
                layouts[name] = layout
            try:
                self.file.parent.mkdir(parents=True, exist_ok=True)
                write_json(self.file, {"schema_version": SCHEMA_VERSION, "layouts": layouts})
            except OSError as error:
                raise InputError.at(self.file, messages.NOT_WRITTEN(reason=error.strerror)) from None
        return layouts
