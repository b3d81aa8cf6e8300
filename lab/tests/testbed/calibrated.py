"""Calibrations of the tests: the files that `calibrate` writes, read again."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dwell
from dwell.model import Problem
from dwell_lab.testbed import calibrate as product


@dataclass(frozen=True)
class Calibrated:
    """A cell file that was written, its sidecar, and what is in both."""

    cell: Path
    sidecar: Path
    problem: Problem
    report: dict[str, Any]

    @property
    def samples(self) -> Path:
        """File with the samples."""
        return self.cell.with_name(f"{self.cell.stem}.samples.parquet")

    @property
    def missing(self) -> tuple[str, ...]:
        """Tasks and links that no run has visited."""
        return tuple(self.report["missing"])


def calibrate(
    cell: Path,
    runs: Sequence[Path],
    out: Path,
    *,
    emulated: bool = True,
    say: Callable[[str], None] = print,
) -> Calibrated:
    """Calibrate a cell, and read the files that it has been written to."""
    product.calibrate(cell, runs, out, emulated=emulated, say=say)
    sidecar = out.with_name(f"{out.stem}.calibration.json")
    return Calibrated(out, sidecar, dwell.load(out), json.loads(sidecar.read_text()))
