"""What a folder of a run says, in numbers; also run by the version that wrote the folders."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import polars as pl

import dwell

FOLDER = Path(__file__).parent / "data" / "old-runs"
EXPECTED = FOLDER / "facts.json"


def facts(folder: Path) -> dict[str, Any]:
    """Return the sums of all columns of integers and truth values, the rows, and what was decided.

    Parameters
    ----------
    folder : Path
        Of a run, sealed or with a journal only.
    """
    run = dwell.open_run(folder)
    found: dict[str, Any] = {}
    for name in ("cycles", "windows", "decisions"):
        table: pl.DataFrame = getattr(run, name)
        counted = [
            column
            for column, kind in table.schema.items()
            if kind.is_integer() or kind == pl.Boolean
        ]
        found[name] = {"rows": table.height, **{one: table[one].sum() for one in counted}}
    found["decided"] = run.decisions.select("placement", "reason").cast(pl.String).rows()
    rates = run.windows["violation_rate"].fill_nan(None)
    found["violation_rate"] = round(float(rates.drop_nulls().sum()), 9)
    return found


if __name__ == "__main__":
    folders = sorted(
        {
            path.parent
            for name in ("run.json", "journal.bin")
            for path in Path(sys.argv[1]).rglob(name)
        }
    )
    print(json.dumps({str(one.relative_to(sys.argv[1])): facts(one) for one in folders}, indent=1))
