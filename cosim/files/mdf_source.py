"""Measurement files of ASAM MDF 4, read by asammdf; each channel has its own times."""

from __future__ import annotations

import gc
import sys
from collections.abc import Collection, Container
from pathlib import Path

import numpy as np

from cosim.core.errors import Fault, InputError
from cosim.core.extras import optional
from cosim.core.text import counted, join_names
from cosim.files.csv_source import MOST_BYTES
from cosim.files.table import Column, Source, Table


class Mdf(Source):
    """Measurement files of ASAM MDF, version 4, and version 3 as far as asammdf reads it."""

    name = "MDF"
    suffixes = (".mf4", ".mdf")
    magic = b"MDF     "

    def read(self, path: Path, names: Container[str] = (), text: Collection[str] = ()) -> Table:
        """Read all channels into one table, with a row for each time of any channel; missing values are NaN."""
        asammdf = optional("asammdf", lambda message: Fault(path, 0, 0, message))
        try:
            with asammdf.MDF(path) as file:
                signals = list(file.iter_channels(copy_master=True))
        except Exception as error:  # asammdf raises errors of many kinds for damaged files
            reason = str(error)[:200]
            # It also raises them when a half-read file object is deleted.
            hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
            error.__traceback__ = error.__context__ = None
            gc.collect()
            sys.unraisablehook = hook
            raise InputError.at(path, f"is an incomplete or invalid MDF file: {reason}; save it again") from None
        rasters = {signal.timestamps.tobytes(): signal.timestamps for signal in signals if signal.timestamps.size}
        if not rasters:
            return Table()
        time = np.unique(np.concatenate([*rasters.values()]))
        if 8 * time.size * len(signals) > MOST_BYTES:
            million = f"{time.size * len(signals) / 1e6:.0f} million values"
            raise InputError.at(path, f"has {million}, above the limit; export fewer channels")
        places = {key: np.searchsorted(time, raster) for key, raster in rasters.items()}
        columns = [Column("time", "s", time)]
        for signal in signals:
            if not signal.timestamps.size or signal.samples.ndim != 1 or signal.samples.dtype.names:
                continue  # no values, an array or a structure
            rows, samples = places[signal.timestamps.tobytes()], signal.samples
            if samples.dtype.kind in "biuf":
                if rows.size == time.size and samples.dtype.kind in "biu":
                    values = samples.astype(np.int64) if samples.dtype.kind != "u" else samples
                else:
                    values = np.full(time.size, np.nan)
                    values[rows] = samples
                columns.append(Column(signal.name, signal.unit or "", values))
            else:
                cells = [""] * time.size
                for row, sample in zip(rows.tolist(), samples.tolist(), strict=True):
                    cells[row] = sample.decode("utf-8", "replace") if isinstance(sample, bytes) else str(sample)
                columns.append(Column(signal.name, signal.unit or "", cells, is_text=True))
        assumed = [f"{counted(len(rasters), 'time channel')} are joined"] if len(rasters) > 1 else []
        omitted = [s.name for s in signals if s.samples.ndim != 1 or s.samples.dtype.names]
        assumed += [f"arrays and structures were not read: {join_names(omitted)}"] if omitted else []
        return Table(columns, assumed=tuple(assumed), own_times=len(rasters) > 1)


MDF = Mdf()
