"""Tables of a study, put together from its parts in the order of the study.

Their bytes do not depend on the order of the parts, nor on their sizes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from dwell.study.parts import LABELS
from dwell.study.reference import CLAIRVOYANT, ORACLE, regret, share_kept
from dwell.study.results import PARAMETER
from dwell.study.study import Study
from dwell.study.study_folder import TABLES
from dwell.study.summary import latency_grid_ms

if TYPE_CHECKING:
    import polars as pl

#: By their names, see `TABLES`.
Tables: TypeAlias = "dict[str, pl.DataFrame]"


def tables_of(study: Study, frames: Iterable[pl.DataFrame]) -> Tables:
    """Return the tables of a study.

    Parameters
    ----------
    frames : iterable of DataFrame
        All runs, in any order (see `dwell.study.parts.frame_of`). Their distributions of latency
        are added up frame by frame, as they are much larger than all the rest.
    """
    import polars as pl

    grids = np.stack(
        [latency_grid_ms(point.problem.pipeline.deadline_ms) for point in study.points]
    )
    groups = len(study.points) * len(study.scenarios) * len(study.policies)
    within = np.zeros((groups, grids.shape[1]), np.int64)
    cycles = np.zeros(groups, np.int64)
    group = (pl.col("point") * len(study.scenarios) + _place("scenario", study.scenarios)) * len(
        study.policies
    ) + _place("policy", study.policies)
    rows = []
    for frame in frames:
        places = frame.select(group).to_series().to_numpy()
        counts = frame["within"].explode().to_numpy()
        np.add.at(within, places, counts.reshape(len(frame), -1))
        np.add.at(cycles, places, frame["cycles"].to_numpy())
        rows.append(frame.drop("within"))
    ordered = pl.concat(rows, how="diagonal").sort(group, _place("seed", study.seeds))
    if study.references:
        ordered = _compared(ordered)
    costs = ordered.select("point", *LABELS, "costs").explode("costs").unnest("costs")
    firsts = ordered.gather_every(len(study.seeds)).select("point", "scenario", "policy")
    latencies = firsts[np.repeat(np.arange(groups), grids.shape[1])].with_columns(
        pl.Series("latency_ms", grids[firsts["point"].to_numpy()].ravel()),
        pl.Series("share", (within / cycles[:, None]).ravel()),
    )
    tables = (
        _with_values(study, ordered.drop("costs")),
        _with_values(study, costs).with_columns(pl.selectors.float().fill_nan(None)),
        _with_values(study, latencies),
    )
    return dict(zip(TABLES, tables, strict=True))


def _place(column: str, names: Sequence[object]) -> pl.Expr:
    """Return the places of a column's values in the order of the study."""
    import polars as pl

    return pl.col(column).replace_strict(list(names), list(range(len(names))))


def _compared(ordered: pl.DataFrame) -> pl.DataFrame:
    """Compare every run with the cheapest reference and the oracle of its realisation."""
    import polars as pl

    keys = ["point", "scenario", "seed"]
    found = ["reference_cost", "best_static", "asked"]
    known = ordered.filter(policy=CLAIRVOYANT).select(*keys, *found)
    oracle = ordered.filter(policy=ORACLE).select(*keys, oracle_cost="cost")
    joined = ordered.drop(found).join(known, on=keys, how="left", maintain_order="left")
    joined = joined.join(oracle, on=keys, how="left", maintain_order="left")
    masks = joined.select("kept", "asked").iter_rows()
    kept = [share_kept(*(np.frombuffer(one, np.bool_) for one in both)) for both in masks]
    costs = joined.select("cost", "reference_cost").iter_rows()
    return joined.drop("kept", "asked", "oracle_cost").with_columns(
        oracle_regret=joined["cost"] / joined["oracle_cost"] - 1.0,
        regret=pl.Series([regret(*both) for both in costs], dtype=pl.Float64),
        share_kept=pl.Series(kept, dtype=pl.Float64),
    )


def _with_values(study: Study, frame: pl.DataFrame) -> pl.DataFrame:
    """Put the values of parameters in place of the index of a point."""
    import polars as pl

    values = [
        pl.Series(PARAMETER + name, [point.values[name] for point in study.points]).gather(
            frame["point"]
        )
        for name in study.parameters
    ]
    return pl.DataFrame([*values, *frame.drop("point")])
