"""The page of metrics, from their declarations: `python -m docs.metrics` writes it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from dwell.dash.metrics import LATENCY, SENTENCES, SUFFIXES
from dwell.study.metric import METRICS

PAGE = Path(__file__).with_name("reference") / "metrics.md"
TEXT = """# Metrics of runs and of live cells

## Of a run

Columns of a run's summary (`dwell run --json`), of `Comparison.runs` and of a study's
`runs.parquet`, without the warm-up. Tables show shares in percent; columns have them in [0, 1].
[Concepts](../concepts.md) defines the metrics, and [studies](../howto/studies.md#the-results) the
comparisons with references. `python -m docs.metrics` writes this page.

| column | name | unit | better |
|---|---|---|---|
{rows}

## Of a live cell

Series for [Prometheus](../howto/monitoring.md#numbers-for-prometheus). Each has the label `cell`,
and labels for its node, task, flow, placement, process, reason or outcome. Unknown values are
absent, not 0.

| series | kind | meaning |
|---|---|---|
{series}
"""


def rows() -> Iterator[str]:
    """Yield a row for each metric."""
    for column, metric in METRICS.items():
        shown = column.replace("{", "<").replace("}", ">")
        title = metric.title.replace("{", "`<").replace("}", ">`")
        yield f"| `{shown}` | {title} | {metric.unit} | {metric.better} |"


def series() -> Iterator[str]:
    """Yield a row for each series of a live cell."""
    name, sentence = LATENCY
    yield f"| `{name}` | histogram | {sentence} |"
    for kind, sentences in SENTENCES.items():
        for name, sentence in sentences.items():
            yield f"| `{name}{SUFFIXES[kind]}` | {kind} | {sentence} |"


def page() -> str:
    """Return the page."""
    return TEXT.format(rows="\n".join(rows()), series="\n".join(series()))


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
