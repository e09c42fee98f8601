"""All cases."""

from __future__ import annotations

from tests.known import couplings, files, interfaces, sources, values

CASES = [*sources.CASES, *couplings.CASES, *interfaces.CASES, *values.CASES, *files.CASES]
