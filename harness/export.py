"""Results as VNN-COMP's results.csv."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

from harness.records import Record


def results_csv(records: Sequence[Record]) -> bytes:
    """Return the six columns, no header.

    category, network, property, prepare_time, result, run_time; seconds. Files are named
    relative to the benchmarks folder.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for record in records:
        times = f"{record.prepare_time:.3f}", f"{record.run_time:.3f}"
        row = (record.category, record.onnx, record.spec, times[0], record.result, times[1])
        writer.writerow(row)
    return text.getvalue().encode()
