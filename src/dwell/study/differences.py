"""Differences in several metrics, a family each, side by side in one table."""

from __future__ import annotations

from collections.abc import Mapping

from dwell.study.chapter import Table, Unit
from dwell.study.family import Family

__all__ = ["centre", "difference_table", "shown_as"]

#: Metrics that policies are compared by: their names, and how differences are written.
METRICS: Mapping[str, tuple[str, Unit]] = {
    "violation_rate": ("V_D", "change"),
    "l95_ms": ("L95 (ms)", "ms"),
    "u_robot": ("U_r", "change"),
    "cost": ("J", "cost"),
    "j_still": ("J without switching", "cost"),
    "migrations": ("migrations", "number"),
    "returns": ("returns", "number"),
    "moved": ("tasks moved", "number"),
    "tracking_rms_mm": ("tracking RMS (mm)", "number"),
    "regret": ("regret", "change"),
}


def centre(family: Family, name: str) -> float:
    """Return the mean (or median) difference of a comparison."""
    item = family.comparisons[name]
    return float(getattr(item, "mean", getattr(item, "median", float("nan"))))


def shown_as(metric: str) -> str:
    """Name of a metric in sentences and headings."""
    return METRICS[metric][0]


def difference_table(
    compared: Mapping[str, Family],
    *,
    slug: str,
    title: str,
    note: str = "",
    where: str = "scenario",
) -> Table:
    """One row a comparison: in every metric the difference, its interval and the verdict.

    Parameters
    ----------
    compared : mapping of metric to Family
        With the same comparisons, by names as ``robot-cpu-stress: dtp, atp``.
    slug, title, note : str
        Of the table; the note begins with what a difference is.
    where : str
        What stands before the colon.
    """
    import polars as pl

    first = next(iter(compared.values()))
    rows = []
    said = {metric: family.verdicts for metric, family in compared.items()}
    adjusted = {metric: family.adjusted for metric, family in compared.items()}
    for name in first.comparisons:
        place, _, pair = name.rpartition(": ")
        row: dict[str, object] = {where: place, "comparison": pair}
        for metric, family in compared.items():
            item = family.comparisons[name]
            row |= {
                metric: centre(family, name),
                f"{metric}_low": item.low,
                f"{metric}_high": item.high,
                f"{metric}_p": adjusted[metric][name],
                f"{metric}_said": said[metric][name],
            }
        rows.append(row | {"n": first.comparisons[name].n})
    units: dict[str, Unit] = {where: "text", "comparison": "text"}
    headings: dict[str, str] = {}
    for metric in compared:
        called, unit = METRICS[metric]
        units |= {metric: unit, f"{metric}_p": "p", f"{metric}_said": "text"}
        headings |= {metric: called, f"{metric}_p": "p (Holm)", f"{metric}_said": f"{called} is"}
    seeds = {item.n for item in first.comparisons.values()}
    pairs = f"{min(seeds)} seeds" if len(seeds) == 1 else f"{min(seeds)} to {max(seeds)} seeds"
    stands = (
        f"The first less the second, paired over {pairs}; sign-flip tests, Holm over the "
        f"{len(first.comparisons)} comparisons of a metric."
    )
    return Table(
        slug=slug,
        title=title,
        frame=pl.DataFrame(rows, infer_schema_length=None).fill_nan(None),
        units=units,
        headings=headings,
        note=f"{stands} {note}".strip(),
    )
