"""V_D of every policy in every scenario, drawn from a chapter's main table."""

from __future__ import annotations

from dwell.study.chapter import Figure, Table
from dwell.study.comparison import AIM
from dwell.study.paper.sentences import number

__all__ = ["rates_figure"]


def rates_figure(main: Table, title: str) -> Figure:
    """V_D with its interval, by policy and scenario, beside the aim.

    Parameters
    ----------
    main : Table
        With columns ``scenario``, ``policy``, ``violation_rate`` and its limits.
    title : str
    """
    return Figure(
        slug=f"{main.slug}-rates",
        title=title,
        kind="intervals",
        frame=main.frame.select(
            "scenario",
            "policy",
            y="violation_rate",
            y_low="violation_rate_low",
            y_high="violation_rate_high",
        ),
        x="policy",
        y="y",
        series="policy",
        facet="scenario",
        y_label="V_D",
        y_unit="percent",
        line_at=AIM,
        line_label=f"{number(100 * AIM, 0)} %",
        note=main.note,
    )
