"""Map of robot, edge and cloud: `python -m docs.cloud_map STUDY`.

STUDY is the folder of `dwell study examples/studies/clouds.yaml`. The command writes cloud-map.csv
and cloud-map.svg to docs/images, or to the folder `--out`, and prints how often each place wins. A
place wins clearly if the 95 % interval of its difference to the next place excludes 0.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import polars as pl

from dwell.report.figure import Figure, Spec, printed_svg
from dwell.report.figure_files import BOTH_PT
from dwell.report.palette import Palette
from dwell.study import open_study, paired_difference
from reproduction.evidence.measured_on import measured_on

IMAGES = Path(__file__).parent / "images"
#: Columns of the study's parameters.
DELAY, JITTER, EVERY = (
    f"parameter.{name}"
    for name in (
        "links[1].delay_ms.lognormal.mean",
        "links[1].delay_ms.lognormal.cv",
        "tasks.observe.every",
    )
)
PLACES = "ROBOT", "EDGE", "CLOUD"
#: Rows of panels: the metric that decides, and the places to choose from.
ROWS: dict[str, tuple[str, Sequence[str]]] = {
    "mean age": ("aoi_mean_ms", PLACES),
    "J": ("cost", PLACES),
    "J, no edge": ("cost", ("ROBOT", "CLOUD")),
}


def winners(runs: pl.DataFrame) -> Iterator[dict[str, object]]:
    """Yield the best place of each point and row of panels, and its margin in percent."""
    period_ms = 40
    for row, (metric, places) in ROWS.items():
        for (delay_ms, jitter, every), here in runs.group_by(
            [DELAY, JITTER, EVERY], maintain_order=True
        ):
            values = {
                name: here.filter(policy=name).sort("seed")[metric].to_numpy() for name in places
            }
            first, second, *_ = sorted(places, key=lambda name: float(values[name].mean()))
            margin = paired_difference(values[second], values[first])
            yield {
                "row": row,
                "interval_ms": period_ms * int(every),
                "rtt_ms": 2 * delay_ms,
                "jitter": jitter,
                "winner": first,
                "margin_percent": 100 * margin.mean / float(values[second].mean()),
                "clear": margin.low > 0,
            }


def figure(won: pl.DataFrame) -> Figure:
    """Draw the winner of each point; points without a clear winner are pale."""
    styles = Palette.of(PLACES).placements
    margin = pl.col("margin_percent").round(0).cast(pl.Int64).cast(pl.String)
    shown = won.with_columns(text=pl.when("clear").then(margin).otherwise(pl.lit("")))

    def draw(width: float) -> Spec:
        columns = shown["interval_ms"].n_unique()
        axis = {"labelAngle": 0, "grid": False, "domain": False, "ticks": False}
        across = {
            "x": {
                "field": "rtt_ms",
                "type": "ordinal",
                "title": "round trip to the cloud (ms)",
                "axis": axis,
            },
            "y": {
                "field": "jitter",
                "type": "ordinal",
                "sort": "descending",
                "title": "deviation / mean",
                "axis": axis,
            },
        }
        colour = {
            "field": "winner",
            "type": "nominal",
            "title": None,
            "scale": {"domain": list(PLACES), "range": [styles[name] for name in PLACES]},
        }
        opacity = {"condition": {"test": "datum.clear", "value": 1}, "value": 0.35}
        return {
            "data": {"name": "rows"},
            "facet": {
                "row": {"field": "row", "sort": list(ROWS), "title": None},
                "column": {
                    "field": "interval_ms",
                    "title": "time between requests (ms)",
                    "header": {"titlePadding": 2, "labelPadding": 2},
                },
            },
            "spacing": {"row": 8, "column": 8},
            "spec": {
                "width": (width - 90) / columns,
                "height": 70,
                "encoding": across,
                "layer": [
                    {
                        "mark": {"type": "rect", "stroke": "white", "strokeWidth": 0.6},
                        "encoding": {"color": colour, "opacity": opacity},
                    },
                    {
                        "mark": {"type": "text", "fontSize": 5.5, "color": "white"},
                        "encoding": {"text": {"field": "text"}},
                    },
                ],
            },
        }

    return Figure("cloud-map", "Where robot, edge and cloud win", {"rows": shown}, draw)


def table(won: pl.DataFrame) -> Iterator[str]:
    """Yield the lines of a table of how many points each place wins."""
    yield "| by | requests every | " + " | ".join(PLACES) + " | of |"
    yield "|---" * (3 + len(PLACES)) + "|"
    for (row, interval_ms), here in won.group_by(["row", "interval_ms"], maintain_order=True):
        counts = [
            f"{mine.height} ({mine['clear'].sum()})"
            if (mine := here.filter(winner=name)).height
            else "–"
            for name in PLACES
        ]
        yield f"| {row} | {interval_ms} ms | " + " | ".join(counts) + f" | {here.height} |"


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the map and its data, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m docs.cloud_map", description=__doc__)
    parser.add_argument("study", help="folder of the study")
    parser.add_argument("--out", type=Path, default=IMAGES, help="folder of the files")
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    won = pl.DataFrame(list(winners(open_study(given.study).runs)))
    won.write_csv(given.out / "cloud-map.csv", float_precision=4)
    drawing = printed_svg(figure(won), BOTH_PT)
    (given.out / "cloud-map.svg").write_text(drawing, encoding="utf-8")
    print(measured_on())
    print("\nPoints that each place wins (clearly):\n")
    print("\n".join(table(won)))


if __name__ == "__main__":
    main()
