"""The output `valid` of an FMU, which tells other tools when a run leaves the region of the logs."""

from __future__ import annotations

from pathlib import Path

from cosim.core.errors import InputError
from cosim.credibility.record import attach, require_credibility
from cosim.credibility.region import LEAST_SAMPLE, Region
from cosim.files.files import FilePath, check_folder, named_path
from cosim.files.kinds import refuse_unreadable
from cosim.fmi.description import read_description
from cosim.fmi.native.compiler import CompilerFailed, NoCompiler
from cosim.fmi.native.printing import number, table
from cosim.fmi.wrapping.wrap import NO_INDICATOR, CannotWrap, Indicator, wrap
from cosim.terms.code import TermCode

CODE = Path(__file__).with_name("region.c")


def add_valid_output(fmu: FilePath, folder: FilePath = Path("build")) -> tuple[Path, dict[str, str]]:
    """Write a copy of an FMU that has a further Boolean output `valid`: whether it is within the region of its record.

    The region is compiled into a small library around the FMU.

    Args:
        fmu: FMU of `cosim refine` or `cosim fit`, with a record of credibility.
        folder: Folder for the FMU, which keeps its file name.

    Returns:
        Path of the FMU, and platform folder of the original → reason why the FMU has no library for it.

    Raises:
        InputError: The FMU has no valid record, cannot have this output, or no compiler is installed.
        FmuError: The FMU cannot be read.
    """
    source, folder = named_path(fmu), named_path(folder)
    refuse_unreadable(source, "an FMU")
    read_description(source)
    record, problem = require_credibility(source)
    if problem:
        raise InputError.at(source, f"{problem}; get the FMU from its author again")
    out = folder / source.name
    if out.resolve() == source.resolve():
        raise InputError.at(source, "would be replaced by the FMU with the output `valid`; choose another --out")
    check_folder(folder)
    try:
        left_out = wrap(source, TermCode("", (), hooks=()), {}, out, indicator=indicator_of(record.region))
    except (CannotWrap, NoCompiler, CompilerFailed) as error:
        raise InputError.at(source, str(error)) from None
    attach(out, record)
    return out, left_out


def indicator_of(region: Region) -> Indicator:
    """Return the code of the output `valid` of a region; without a region, `valid` is always false."""
    if region.reason:
        return NO_INDICATOR
    coordinates = region.coordinates
    signals = [*dict.fromkeys(c.signal for c in coordinates)]
    sizes = {
        "HAS_REGION": 1,
        "COORDINATES": len(coordinates),
        "REGION_POINTS": len(region.points),
        "REGION_THRESHOLD": number(max(region.threshold, 1e-300)),
        "LEAST_SAMPLE": number(LEAST_SAMPLE * region.step),
    }
    source = [
        "/* The region of the logs; of each coordinate its values at all points, scaled: (value - low) / scale. */\n",
        *(f"#define {name} {value}\n" for name, value in sizes.items()),
        table("int", "REGION_SIGNAL", (str(signals.index(c.signal)) for c in coordinates)),
        table("int", "REGION_IS_RATE", (str(int(c.kind == "rate")) for c in coordinates)),
        table("double", "REGION_LOW", (number(c.low) for c in coordinates)),
        table("double", "REGION_SCALE", (number(c.scale) for c in coordinates)),
        table(
            "double", "REGION_POINT", (", ".join(map(number, values)) for values in zip(*region.points, strict=True))
        ),
        "\n" + CODE.read_text(encoding="utf-8"),
    ]
    return Indicator("".join(source), tuple(signals), tuple(c.signal for c in coordinates if c.kind == "rate"))
