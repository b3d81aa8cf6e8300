"""The page of metrics, from their declarations: `python -m docs.metrics` writes it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from dwell.study.metric import METRICS

PAGE = Path(__file__).with_name("reference") / "metrics.md"
TEXT = """# Metrics of a run

Columns of a run's summary (`dwell run --json`), of `Comparison.runs` and of a study's
`runs.parquet`, without the warm-up. Tables show shares in percent; columns have them in [0, 1].
[Concepts](../concepts.md) defines the metrics, and [studies](../howto/studies.md#the-results) the
comparisons with references. `python -m docs.metrics` writes this page.

| column | name | unit | better |
|---|---|---|---|
{rows}
"""


def rows() -> Iterator[str]:
    """Yield a row for each metric."""
    for column, metric in METRICS.items():
        shown = column.replace("{", "<").replace("}", ">")
        title = metric.title.replace("{", "`<").replace("}", ">`")
        yield f"| `{shown}` | {title} | {metric.unit} | {metric.better} |"


def page() -> str:
    """Return the page."""
    return TEXT.format(rows="\n".join(rows()))


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
