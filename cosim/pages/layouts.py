"""Named layouts of the signal browser, stored in one JSON file."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

from cosim.core.errors import InputError
from cosim.files.files import open_bytes, parse_json, write_json

MAX_LAYOUTS_BYTES = 1 << 26  # of a file


class Layouts:
    """Layouts in a file, which is checked at the start and rewritten whole at each change.

    Raises:
        InputError: The file exists, but is not a file of layouts.
    """

    def __init__(self, file: Path) -> None:
        self.file, self._lock = file, threading.Lock()
        self.read()

    def read(self) -> dict[str, Any]:
        """Return name → layout."""
        content: Any = None
        try:
            with open_bytes(self.file) as stream:
                content = parse_json(stream.read(MAX_LAYOUTS_BYTES))
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, RecursionError):
            pass  # refused below
        layouts = content.get("layouts") if isinstance(content, dict) and content.get("schema_version") == 1 else None
        if not isinstance(layouts, dict) or not all(isinstance(layout, dict) for layout in layouts.values()):
            raise InputError.at(self.file, "is not a layout file of `cosim view`; give another --layout")
        return layouts

    def put(self, name: str, layout: Any) -> dict[str, Any]:
        """Save a layout under a name, or remove it if `layout` is None; return all layouts."""
        with self._lock:
            layouts = {key: value for key, value in self.read().items() if key != name}
            if layout is not None:
                layouts[name] = layout
            try:
                self.file.parent.mkdir(parents=True, exist_ok=True)
                write_json(self.file, {"schema_version": 1, "layouts": layouts})
            except OSError as error:
                raise InputError.at(self.file, f"cannot be written: {error.strerror}; give another --layout") from None
        return layouts
