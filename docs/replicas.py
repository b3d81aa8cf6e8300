"""Figure and table of "When does a second copy pay?": `python -m docs.replicas`, a minute.

It simulates examples/replicas.yaml for several `after_ms`, writes replicas.csv and replicas.svg to
docs/images, or to the folder `--out`, and prints the table.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl

import dwell
from dwell.display import Measure
from dwell.model import Problem, Replicas
from dwell.report.charts import curves
from dwell.report.figure import Figure, Spec, printed_svg
from dwell.report.figure_files import BOTH_PT
from dwell.report.palette import Palette
from dwell.study import mean_interval

ROOT = Path(__file__).parents[1]
CELL = ROOT / "examples" / "replicas.yaml"
IMAGES = ROOT / "docs" / "images"
AFTER_MS = (0.0, 2.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 9.5, 10.0, 11.0, 12.0, 13.5, 15.0)
ALONE, TWO = "ONE alone", "two copies"
LATE, SENT = "cycles over 15 ms, %", "second copies, % of the cycles"


def shares(
    problem: Problem, policy: str, windows: int, seeds: int
) -> Iterator[tuple[float, float]]:
    """Yield for each seed the share of late cycles, and second copies per cycle, in %."""
    deadline_ns = problem.pipeline.deadline_ns
    for seed in range(1, seeds + 1):
        run = dwell.simulate(problem, policy=policy, seed=seed, windows=windows, jobs=True)
        assert run.jobs is not None
        late = run.cycles["latency_ns"].to_numpy() > deadline_ns
        second = run.jobs["second"].to_numpy()
        yield 100 * float(np.mean(late)), 100 * float(np.sum(second)) / len(late)


def rows(windows: int, seeds: int) -> pl.DataFrame:
    """Return mean and interval of both shares for each `after_ms`, without and with replicas."""
    problem, found = dwell.load(CELL), []
    members = {name: problem.candidates[name] for name in ("ONE", "TWO")}
    alone = [*shares(problem, "ONE", windows, seeds)]
    for after_ms in AFTER_MS:
        candidates = {**members, "LATER": Replicas(members, after_ms)}
        hedged = [*shares(replace(problem, candidates=candidates), "LATER", windows, seeds)]
        for column, panel in enumerate((LATE, SENT)):
            for name, of in ((ALONE, alone), (TWO, hedged)):
                mean, low, high = mean_interval(np.array([one[column] for one in of]))
                line = {"scenario": panel, "policy": name, "at": after_ms}
                found.append({**line, "mean": mean, "low": low, "high": high})
    return pl.DataFrame(found)


def figure(data: pl.DataFrame) -> Figure:
    """Draw both shares over `after_ms`."""
    styles = Palette.of((), (ALONE, TWO)).policies
    drawn = curves(data, Measure("mean", "mean over seeds"), styles, "after_ms")

    def draw(width: float) -> Spec:
        return {**drawn(width), "resolve": {"scale": {"y": "independent"}}}

    return Figure("replicas", "When does a second copy pay?", {"rows": data}, draw)


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the figure and its data, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m docs.replicas", description=__doc__)
    parser.add_argument("--out", type=Path, default=IMAGES, help="folder of the files")
    folder = parser.parse_args(arguments).out
    folder.mkdir(parents=True, exist_ok=True)
    data = rows(windows=1000, seeds=5)
    data.write_csv(folder / "replicas.csv", float_precision=6)
    drawing = printed_svg(figure(data), BOTH_PT)
    (folder / "replicas.svg").write_text(drawing, encoding="utf-8")
    for line in data.iter_rows():
        print(*line, sep="\t")


if __name__ == "__main__":
    main()
