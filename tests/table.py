"""The model of docs/own_model.md, as a reader would copy it."""

from pathlib import Path

DOCS = Path(__file__).parent.parent / "docs"
TABLE = (DOCS / "own_model.md").read_text(encoding="utf-8").split("```python\n")[1].split("```")[0]
