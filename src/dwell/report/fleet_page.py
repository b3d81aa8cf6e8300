"""Page of a fleet: the cells, their placements over time, and the effects of rounds."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from dwell.display import Measure, write_number
from dwell.errors import SimulationError
from dwell.model.bounds import counted
from dwell.model.disturbed import Disturbed, disturbed
from dwell.model.table_columns import SHARE_OF
from dwell.report.capacity_page import PHASES
from dwell.report.charts import (
    coloured,
    disc,
    latency_limit,
    layer,
    name_of,
    names,
    quantity,
)
from dwell.report.figure import Figure, Spec
from dwell.report.formatting import percent, write_ms
from dwell.report.page import Definitions, Fact, Page, Section
from dwell.report.palette import INK, MUTED, Palette
from dwell.report.table import MOST_ROWS, WITH_WARMUP, WITHOUT_WARMUP, Columns, Table, Text
from dwell.report.timeline import FAR, fleet_timeline, rows_px
from dwell.report.topology import topology
from dwell.study.fleet_summary import fleet_numbers, refusals
from dwell.study.metric import METRICS, metric_of

if TYPE_CHECKING:
    import polars as pl

    from dwell.record import FleetRun

#: Metrics of a cell.
RATE, L95, COST = (METRICS[name] for name in ("violation_rate", "l95_ms", "cost"))
#: Room next to the panels of cells, and between them, pixels.
BESIDE_PX, GAP_PX = 120, 18
ROUNDS_PX = 190
#: Largest number of cells for which the table of cells is open.
UNFOLDED = 24
#: Most outliers that are named.
MOST_NAMED = 5
#: Target of a move in figures if the cell stays.
STAYS = "no move"


def fleet_page(run: FleetRun, *, links: Mapping[str, str] | None = None) -> Page:
    """Return the page of a run of a fleet; `SimulationError` without windows after the warm-up.

    `links` has the addresses of the pages of cells, by the name of the cell.
    """
    return _FleetPage(run, links or {}).page()


class _FleetPage:
    """The parts of the page of a fleet."""

    def __init__(self, run: FleetRun, links: Mapping[str, str]) -> None:
        self.run, self.links = run, links
        self.numbers = fleet_numbers(run)
        self.cells: list[dict[str, Any]] = self.numbers["cells"]
        if not self.cells:
            raise SimulationError("no window is left after the warm-up; ask for more windows")
        self.names = [str(row["cell"]) for row in self.cells]
        self.problems = run.fleet.problems
        self.aim = f"{100 * run.fleet.aim:g} %"
        candidates = dict.fromkeys(
            name for problem in self.problems.values() for name in problem.candidates
        )
        used = set(run.windows["placement"].cast(str))
        self.palette = Palette.of(candidates)
        #: Colours of the placements that at least one cell used.
        self.used = {name: hue for name, hue in self.palette.placements.items() if name in used}

    def page(self) -> Page:
        fleet = self.run.fleet
        return Page(
            title=f"Fleet {fleet.name}",
            subtitle=" · ".join(
                (
                    counted(len(self.cells), "cell"),
                    f"sharing {', '.join(fleet.shared) or 'nothing'}",
                    f"coordination: {fleet.coordination}",
                    f"phases: {fleet.phasing}",
                    f"seed {self.run.seed}",
                    f"{write_number(self.run.seconds, 0)} s",
                )
            ),
            facts=list(self._facts()),
            sections=list(self._sections()),
        )

    def _facts(self) -> Iterator[Fact]:
        worst, numbers = self.cells[0], self.numbers
        kept = sum(row["verdict"] == "kept" for row in self.cells)
        yield Fact("V_D of the worst cell", RATE.text(worst["violation_rate"]), worst["cell"])
        yield Fact("cells that keep the aim", f"{kept}", f"of {len(self.cells)}; under {self.aim}")
        yield Fact("J", COST.text(numbers["cost"]), "mean over cells")
        most = max(row["moves"] for row in self.cells)
        yield Fact("moves", write_number(numbers["moves"], 0), f"at most {most} of a cell")
        if self.run.guard:
            yield Fact("moves of guards", write_number(numbers["guard_moves"], 0))
        for name, load in numbers["load"].items():
            yield Fact(f"U of {name}", percent(load["mean"]), f"at most {percent(load['most'])}")

    def _sections(self) -> Iterator[Section]:
        yield Section("", [self._time()])
        yield Section("Cells, the worst first", [self._drawn_cells()])
        yield Section("Topology", list(self._topologies()))
        yield Section("Cells in numbers", [self._table()], folded=len(self.cells) > UNFOLDED)
        if self.numbers["rounds"]:
            yield Section("Rounds of the ledger", self._rounds())
        if refused := refusals(self.run):
            yield Section("Refused moves", [self._refused(refused)])
        yield Section("What this is", [self._about()])

    # ------------------------------------------------------------------------------ in time

    def _time(self) -> Figure:
        return fleet_timeline(
            self.run,
            self.names,
            slug="time",
            colours=self.used,
            disturbed=self._disturbed(),
            caption=(
                "A row is a cell, the worst first, in the colour of its placement. V_D: median and "
                f"quartiles of the cells; circles: outliers{self._outliers()}. Dashed: the aim of "
                f"{self.aim}. U: all load of a shared node, foreign work included. Upright lines: "
                "moves; in colour, a guard's. Shaded: warm-up and disturbances."
            ),
        )

    def _outliers(self) -> str:
        """Return the names of the cells far above the others in V_D of the whole run."""
        rates = np.array([row["violation_rate"] for row in self.cells])
        low, high = np.quantile(rates, (0.25, 0.75))
        far = [
            row["cell"] for row in self.cells if row["violation_rate"] > high + FAR * (high - low)
        ]
        return f"; in the whole run {', '.join(far[:MOST_NAMED])}" if far else ""

    def _disturbed(self) -> list[Disturbed]:
        """Return the disturbances of cells, with the number of cells unless all have them."""
        count = Counter[Disturbed]()
        for entry in self.run.fleet.entries:
            for one in disturbed(entry.cell.scenario(entry.scenario), entry.cell.fabric):
                count[one] += entry.count
        of = len(self.cells)
        return [
            one if k == of else one._replace(what=f"{one.what} ({k} of {of} cells)")
            for one, k in count.items()
        ]

    # -------------------------------------------------------------------------------- cells

    def _drawn_cells(self) -> Figure:
        import polars as pl

        # Cells of several files have several deadlines.
        tails = {name: latency_limit(one).value for name, one in self.problems.items()}
        limits = {
            RATE: dict.fromkeys(tails, 100 * self.run.fleet.aim),
            L95: {name: limit for name, limit in tails.items() if math.isfinite(limit)},
            COST: {},
        }
        rows = [
            {
                "cell": row["cell"],
                "measure": measure.heading,
                "value": row[measure.column] * measure.factor,
                "limit": limits[measure].get(row["cell"]),
                # An axis needs a value in every panel.
                "at": limits[measure].get(row["cell"], row[measure.column] * measure.factor),
            }
            for measure in limits
            for row in self.cells
        ]
        return Figure(
            "cells",
            "",
            {"rows": pl.DataFrame(rows, infer_schema_length=None)},
            lambda width: _dots(self.names, [one.heading for one in limits], width),
            f"Means over the windows after the warm-up. Dashed: the aim of {self.aim}, and the "
            "deadline or age limit.",
        )

    def _topologies(self) -> Iterator[Figure]:
        """Yield one drawing per entry: its cells are alike."""
        fleet = self.run.fleet
        shared = f" All cells share {', '.join(fleet.shared)}." if fleet.shared else ""
        for place, entry in enumerate(fleet.entries):
            yield topology(
                entry.cell,
                f"topology-{place}",
                f"{counted(entry.count, 'cell')} of this kind.{shared}",
            )

    def _table(self) -> Table:
        import polars as pl

        counts = self.run.windows.filter(~pl.col("warmup")).group_by("cell", "placement").len()
        at = {(cell, str(name)): count for cell, name, count in counts.rows()}
        rows = []
        for row in self.cells:
            cell = row["cell"]
            spent = {name: at.get((cell, name), 0) for name in self.used}
            windows = sum(spent.values())
            shares = {
                SHARE_OF.format(candidate=name): count / windows for name, count in spent.items()
            }
            rows.append({**row, **shares, "page": self.links.get(cell, "")})
        columns: Columns = [
            Text("cell", "cell", "cell", "{page}"),
            RATE,
            Text("verdict", "verdict", "word"),
            L95,
            COST,
            Measure("moves", "moves"),
            *(metric_of(SHARE_OF.format(candidate=name)) for name in self.used),
        ]
        caption = (
            "L95 as seen at the windows’ closes. Last columns: share of windows by placement. "
            f"{WITHOUT_WARMUP}"
        )
        return Table("cell-table", "", columns, rows, caption=caption, palette=self.palette)

    # ------------------------------------------------------------------------------- rounds

    def _closes(self) -> pl.DataFrame:
        """Return the end of each cell's windows, ``at``, in s."""
        import polars as pl

        cycles = pl.DataFrame(
            [
                {"cell": name, "each": one.window_cycles, "period": one.pipeline.period_ms / 1e3}
                for name, one in self.problems.items()
            ]
        )
        return self.run.windows.join(cycles, on="cell").select(
            "cell", "window", at=(pl.col("first_cycle") + pl.col("each")) * pl.col("period")
        )

    def _rounds(self) -> list[Figure | Table]:
        import polars as pl

        asked = (
            self.run.decisions.filter(pl.col("phi_before").is_not_null())
            .join(self._closes(), on=["cell", "window"], how="left")
            .sort("round")
            .select(
                "round",
                "cell",
                "at",
                "phi_before",
                "phi_after",
                "migrated",
                to=pl.when("migrated").then(pl.col("placement").cast(str)).otherwise(pl.lit(STAYS)),
                **{"from": pl.col("incumbent").cast(str)},
            )
        )
        seen = set(asked["to"])
        colours = {to: hue for to, hue in {**self.used, STAYS: MUTED}.items() if to in seen}
        columns: Columns = [
            Text("round", "round"),
            Measure("at", "at", "s"),
            Text("cell", "cell", "cell"),
            Text("from", "from", "placement"),
            Text("to", "to", "placement"),
            Measure("phi_before", "Φ before", decimals=3),
            Measure("phi_after", "Φ after", decimals=3),
            Measure("fall", "lower by", decimals=3),
        ]
        moved = asked.filter("migrated").with_columns(
            fall=pl.col("phi_before") - pl.col("phi_after")
        )
        rows = moved.head(MOST_ROWS).to_dicts()
        return [
            Figure(
                "rounds",
                "Φ before and after every round",
                {"rows": asked},
                lambda width: _phi(colours, width),
                "Played by the ledger at closes: the fleet as it was, and with the move that was "
                "looked at. A point is Φ with the move, in the colour of where it leads.",
            ),
            Table(
                "round-table",
                f"Rounds that moved cells ({moved['round'].n_unique()} of "
                f"{asked['round'].n_unique()} played)",
                columns,
                rows,
                caption=WITH_WARMUP,
                palette=self.palette,
            ),
        ]

    def _refused(self, refused: Counter[tuple[str, str]]) -> Table:
        rows = [
            {"to": to, "reason": reason, "count": count}
            for (to, reason), count in refused.most_common()
        ]
        columns: Columns = [
            Text("reason", "reason"),
            Text("to", "to", "placement"),
            Measure("count", "refusals"),
        ]
        caption = (
            "Moves that a policy had decided on and coordination did not allow, by its closes. "
            f"{WITH_WARMUP}"
        )
        return Table("refused", "", columns, rows, caption=caption, palette=self.palette)

    # -------------------------------------------------------------------------------- about

    def _about(self) -> Definitions:
        fleet = self.run.fleet
        asks_a_ledger = fleet.coordination == "ledger"
        metas = [run.meta for run in self.run.cells.values()]
        entries = {
            "cells": ", ".join(
                f"{one.count} {one.cell.name} ({one.scenario})" for one in fleet.entries
            ),
            "shared": ", ".join(fleet.shared) or "nothing",
            "phases": PHASES.get(fleet.phasing, "as listed"),
            "coordination": fleet.coordination
            + (f", objective {fleet.objective}" if asks_a_ledger else ""),
            "policy": ", ".join(dict.fromkeys(str(meta.get("policy")) for meta in metas)),
            "estimator": ", ".join(dict.fromkeys(str(meta.get("estimator")) for meta in metas)),
            "deadline": ", ".join(
                dict.fromkeys(write_ms(one.pipeline.deadline_ms) for one in self.problems.values())
            ),
            "record": f"simulated, seed {self.run.seed}",
            "versions": ", ".join(f"{k} {v}" for k, v in metas[0].get("versions", {}).items()),
        }
        return Definitions(entries)


def _dots(cells: Sequence[str], headings: Sequence[str], width: float) -> Spec:
    """Return the drawing of several measures of cells, with one row per cell."""
    where = {
        "x": quantity("value", None, axis={"tickCount": 4}),
        "y": name_of("cell", sort=list(cells), axis={"labelOverlap": True}),
        "tooltip": [*names("cell", "measure"), *(quantity(one, one) for one in ("value", "limit"))],
    }
    shown = {"condition": {"test": "isValid(datum.limit)", "value": 1}, "value": 0}
    limit = {**where, "x": quantity("at", None), "opacity": shown}
    return {
        "data": {"name": "rows"},
        "facet": name_of("measure", sort=list(headings)),
        "columns": len(headings),
        "spacing": GAP_PX,
        "resolve": {"scale": {"x": "independent"}},
        "spec": {
            "width": (width - BESIDE_PX) / len(headings) - GAP_PX,
            "height": rows_px(len(cells)),
            "layer": [
                layer("tick", limit, color=INK, thickness=1, height={"band": 0.6}),
                disc(where, 34, color=INK),
            ],
        },
    }


def _phi(colours: Mapping[str, str], width: float) -> Spec:
    """Return the drawing of Φ by round."""
    about = [
        quantity("round", "round"),
        *names("cell", "from", "to"),
        quantity("at", "at (s)", format=".1f"),
        quantity("phi_before", "Φ before"),
        quantity("phi_after", "Φ after"),
    ]
    axis = {"tickMinStep": 1, "tickCount": 10, "format": "d", "grid": False}
    scale = {"nice": False, "padding": 8}
    up = quantity("phi_before", "Φ", scale={"zero": False}, axis={"tickCount": 5})
    return {
        "width": width - 90,
        "height": ROUNDS_PX,
        "data": {"name": "rows"},
        "encoding": {
            "x": quantity("round", "round", scale=scale, axis=axis),
            "color": coloured("to", colours),
        },
        "layer": [
            layer("rule", {"y": up, "y2": "phi_after"}, strokeWidth=1.3),
            disc({"y": {**up, "field": "phi_after"}, "tooltip": about}, 34),
        ],
    }
