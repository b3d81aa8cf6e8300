"""Means of the paper's study: of each of its studies, by scenario, parameter, policy and metric."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import polars as pl

DATA = Path(__file__).parent / "data"
QUICK, FULL = DATA / "paper-quick.csv", DATA / "paper-full.csv"
#: `parameters` are those of a study that has some, as `name=value` with a space between.
KEYS = ("study", "parameters", "scenario", "policy")
METRICS = ("windows", "cost", "violation_rate", "l95_ms", "u_robot", "u_edge", "migrations", "lost")
DIGITS = 9


def means(folders: Iterable[Path]) -> pl.DataFrame:
    """Return means over seeds, from the folders of studies; each has the study's name.

    Parameters
    ----------
    folders : iterable of Path
        Each holds ``runs.parquet``, one row a run.

    Returns
    -------
    DataFrame
        `KEYS`, ``seeds``, and `METRICS` to nine significant digits.
    """
    found = []
    for folder in sorted(folders, key=lambda one: one.name):
        runs = pl.read_parquet(folder / "runs.parquet")
        varied = [name for name in runs.columns if name.startswith("parameter.")]
        told = [pl.format(f"{name.removeprefix('parameter.')}={{}}", name) for name in varied]
        found.append(
            runs.with_columns(
                study=pl.lit(folder.name),
                parameters=pl.concat_str(told, separator=" ") if told else pl.lit(""),
            )
            .group_by(KEYS, maintain_order=True)
            .agg(
                pl.len().alias("seeds"),
                *(pl.col(name).cast(pl.Float64).mean().round_sig_figs(DIGITS) for name in METRICS),
            )
        )
    return pl.concat(found).sort(KEYS)


def read(file: Path) -> pl.DataFrame:
    """Return means that were written down."""
    return pl.read_csv(file, schema_overrides=dict.fromkeys(KEYS, pl.String))


def write(folder: Path, file: Path) -> int:
    """Replace the means of the studies in a folder; return how many rows there are."""
    found = means(path.parent for path in folder.glob("*/runs.parquet"))
    kept = read(file).filter(~pl.col("study").is_in(found["study"])).fill_null("")
    together = pl.concat([kept, found.select(kept.columns)], how="vertical_relaxed").sort(KEYS)
    together.write_csv(file)
    return together.height
