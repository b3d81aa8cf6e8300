"""Decisions derived again from the tables of a run and the parameters in its record.

The rules are written here once more, from docs/concepts.md and the policies' own pages, on plain
numbers: nothing of `dwell.policies` or `dwell.cost` is used.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import pytest

import dwell

Row: TypeAlias = Mapping[str, Any]

TOLERANCE = 1e-6
#: What a gain must be more than the threshold by.
GAIN_TOLERANCE = 1e-9


# ------------------------------------------------------------------------------- the record


class Record:
    """What a run's folder says: parameters, candidates, and rows of decisions."""

    def __init__(self, folder: Path) -> None:
        self.meta = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        run = dwell.open_run(folder)
        self.rows = list(run.decisions.iter_rows(named=True))
        self.windows = {row["window"]: row for row in run.windows.iter_rows(named=True)}
        document = self.meta["problem"]
        self.width: int = document["window_cycles"]
        self.every = run.problem.decide_cycles
        self.parameters = self.meta["parameters"]
        first = {name: next(iter(task["on"])) for name, task in document["tasks"].items()}
        self.places = {name: {**first, **moves} for name, moves in document["candidates"].items()}
        self.names = list(self.places)
        self.nodes = {name: node["tier"] for name, node in document["nodes"].items()}
        self.accelerators = {
            f"{name}.{kind}": node["tier"]
            for name, node in document["nodes"].items()
            for kind in node.get("accelerators", {})
        }
        self.objective = self.parameters.get("objective", document["objective"])

    def moved(self, one: str, other: str) -> float:
        here, there = self.places[one], self.places[other]
        moved = [task for task in here if here[task] != there[task]]
        return len(moved) / len(here)

    def cost(self, row: Row, name: str, before: str) -> float:
        """J of a candidate's estimate, equation 7 of the paper."""
        weights, targets = self.objective["weights"], self.objective["targets"]
        counted = dict(self.nodes)
        if self.objective.get("accelerators", False):
            counted |= self.accelerators
        busiest = {
            tier: max(
                (row[f"est_u_{one}_{name}"] for one, of in counted.items() if of == tier),
                default=0.0,
            )
            for tier in ("robot", "edge")
        }
        return float(
            weights["latency"] * row[f"est_l95_ms_{name}"] / targets["latency_ms"]
            + weights["violations"] * row[f"est_violation_rate_{name}"]
            + weights["robot"] * busiest["robot"] / targets["robot"]
            + weights["edge"] * busiest["edge"] / targets["edge"]
            + weights["switching"] * self.moved(name, before)
        )

    def error(self, row: Row, name: str) -> float:
        """Standard error of that J."""
        weights, targets = self.objective["weights"], self.objective["targets"]
        latency = weights["latency"] * row[f"est_l95_error_ms_{name}"] / targets["latency_ms"]
        return float(latency + weights["violations"] * row[f"est_violation_error_{name}"])

    def margin(self, row: Row, name: str) -> float:
        """What an advantage of a candidate over the incumbent must exceed."""
        return math.hypot(self.error(row, name), self.error(row, row["incumbent"]))

    def over(self, row: Row, name: str) -> float | None:
        """Largest value / cap - 1, of an L95 as J has it; None without caps."""
        used = max(row[f"est_u_{one}_{name}"] for one in (*self.nodes, *self.accelerators))
        return self.excess(row[f"est_l95_ms_{name}"], used)

    def seen(self, row: Row) -> Row:
        """Metrics that a decision looked at: its own, or those of its window."""
        return row if "seen_l95_ms" in row else self.windows[row["window"]]

    def is_seen_over(self, row: Row) -> bool:
        """Whether the cycles that a decision looked at showed more than a cap."""
        seen = self.seen(row)
        used = max(seen[f"u_{one}"] for one in (*self.nodes, *self.accelerators))
        over = self.excess(seen["seen_l95_ms"], used)
        return over is not None and over > 0

    def excess(self, l95_ms: float, used: float) -> float | None:
        caps = self.objective.get("caps", {})
        if not caps:
            return None
        full = max(used, 1.0) if used >= 0.995 else used
        over = l95_ms / caps.get("latency_ms", math.inf) - 1
        return max(float(over), float(full / caps.get("utilisation", math.inf) - 1))

    def choosable(self, row: Row) -> tuple[list[str], bool]:
        """Candidates to choose from, and whether they are within the caps."""
        within = [name for name in self.names if row[f"eligible_{name}"]]
        if within:
            return within, True
        over = {name: row[f"excess_{name}"] for name in self.names}
        least = min(over.values())
        return [name for name in self.names if over[name] <= least + TOLERANCE], False

    def reason(self, row: Row, best: str, choice: list[str], *, within: bool) -> str:
        if not within:
            return "infeasible"
        out = [name for name in self.names if name not in choice]
        capped = any(row[f"j_{name}"] < row[f"j_{best}"] for name in out)
        return "capped" if capped else "migrate"


def cheapest(costs: Mapping[str, float], incumbent: str) -> str:
    return min(costs, key=lambda name: (costs[name], name != incumbent))


# ---------------------------------------------------------------------------------- the rules


class Rule:
    """A policy's rule; keeps the incumbent, the one before, and the windows since the last move."""

    def __init__(self, record: Record, initial: str) -> None:
        self.record, self.parameters = record, record.parameters
        self.now = self.before = initial
        self.dwelt = 0
        self.begin()

    def begin(self) -> None:
        """Forget what adds up."""

    def wants(self, row: Row) -> tuple[str, str]:
        """Return the candidate and the reason."""
        raise NotImplementedError

    def take(self, name: str) -> None:
        """Let a window pass, and the cell be on a candidate."""
        self.dwelt = self.dwelt + 1 if name == self.now else 0
        self.before, self.now = self.now, name


class Hysteresis(Rule):
    """Algorithm 1, with its escape."""

    def wants(self, row: Row) -> tuple[str, str]:
        record, now = self.record, self.now
        names, within = record.choosable(row)
        best = cheapest({name: row[f"j_{name}"] for name in names}, now)
        elsewhere = [name for name in names if name != now or not within]
        if self.parameters["escape"] and record.is_seen_over(row) and within and elsewhere:
            best = cheapest({name: row[f"j_{name}"] for name in elsewhere}, now)
            return best, record.reason(row, best, elsewhere, within=True)
        if self.dwelt < self.parameters["min_dwell"]:
            return now, "dwell"
        gain = record.cost(row, now, self.before) - row[f"j_{best}"]
        least = self.parameters["min_improvement"] + record.margin(row, best)
        if best != now and gain > least + GAIN_TOLERANCE:
            return best, record.reason(row, best, names, within=within)
        return now, "hold" if within else "infeasible"


class Sums(Rule):
    """CUSUM."""

    def begin(self) -> None:
        self.sums = dict.fromkeys(self.record.names, 0.0)

    def wants(self, row: Row) -> tuple[str, str]:
        record, now, set_to = self.record, self.now, self.parameters
        stays = record.cost(row, now, now)
        for name in record.names:
            gain = stays - row[f"j_{name}"] - set_to["slack"] - record.margin(row, name)
            grown = max(0.0, set_to["memory"] * self.sums[name] + gain)
            self.sums[name] = 0.0 if name == now else grown
        names, within = record.choosable(row)
        least = set_to["threshold"] + GAIN_TOLERANCE
        due = {n: row[f"j_{n}"] for n in names if self.sums[n] > least}
        best = cheapest(due, now) if due else now
        if best == now or stays - row[f"j_{best}"] <= GAIN_TOLERANCE:
            return now, "hold" if within else "infeasible"
        return best, record.reason(row, best, names, within=within)

    def take(self, name: str) -> None:
        if name != self.now:
            self.begin()
        super().take(name)


class Hindsight(Rule):
    """The work function."""

    def begin(self) -> None:
        self.work = {name: self.distance(self.now, name) for name in self.record.names}

    def distance(self, one: str, other: str) -> float:
        weight = self.record.objective["weights"]["switching"]
        return float(weight * self.record.moved(one, other))

    def wants(self, row: Row) -> tuple[str, str]:
        record, now, share = self.record, self.now, self.record.every / self.record.width
        served = {n: self.work[n] + share * record.cost(row, n, n) for n in record.names}
        self.work = {
            name: min(served[other] + self.distance(other, name) for other in record.names)
            for name in record.names
        }
        names, within = record.choosable(row)
        least = min(served.values())
        totals = {n: served[n] - least + self.distance(n, now) for n in names}
        bound = min(totals.values()) * (1 + 1e-9) + 1e-12
        ties = [n for n in names if totals[n] <= bound]
        away = [n for n in ties if self.distance(n, now) > 1e-9] if now in ties else ties
        best = away[0] if away else now
        margin = share * record.margin(row, best)
        saved = served[now] - least - totals[best]
        if best == now or (now in names and margin > 0 and saved <= margin + GAIN_TOLERANCE):
            return now, "hold" if within else "infeasible"
        return best, record.reason(row, best, names, within=within)


class Quickest(Rule):
    """Latency-first."""

    def wants(self, row: Row) -> tuple[str, str]:
        l95_ms = {name: row[f"est_l95_ms_{name}"] for name in self.record.names}
        best = cheapest(l95_ms, self.now)
        errors = (row[f"est_l95_error_ms_{name}"] for name in (best, self.now))
        least = math.hypot(*errors) + GAIN_TOLERANCE
        if best == self.now or l95_ms[self.now] - l95_ms[best] <= least:
            return self.now, "hold"
        return best, "migrate"


class Thresholds(Rule):
    """One task by thresholds: on the window, or with a cost on the mean of some windows."""

    cost_answers = False

    def begin(self) -> None:
        self.seen: list[Row] = []

    def expected(self, name: str) -> tuple[float, float, float]:
        """Means of L95, U_r and U_e of a candidate."""
        return self.means(self.seen, f"est_l95_ms_{name}", "est_u_{}_" + name)

    def observed(self) -> tuple[float, float, float]:
        """Means of what the windows showed."""
        return self.means([self.record.seen(row) for row in self.seen], "seen_l95_ms", "u_{}")

    def means(self, rows: Sequence[Row], l95_ms: str, used: str) -> tuple[float, float, float]:
        def mean(columns: list[str]) -> float:
            largest = [float(max(row[column] for column in columns)) for row in rows]
            return sum(largest) / len(largest)

        robots = [used.format(n) for n, of in self.record.nodes.items() if of == "robot"]
        edges = [used.format(n) for n, of in self.record.nodes.items() if of == "edge"]
        return mean([l95_ms]), mean(robots), mean(edges)

    def margin(self, here: str, there: str) -> float:
        """What an advantage must exceed: of the error of L95 alone, which is the means'."""
        columns = [f"est_l95_error_ms_{name}" for name in (here, there)]
        means = [sum(row[column] for row in self.seen) / len(self.seen) for column in columns]
        objective = self.record.objective
        scale = objective["weights"]["latency"] / objective["targets"]["latency_ms"]
        return float(scale * math.hypot(*means))

    def total(self, shown: tuple[float, float, float], moved: float) -> float:
        weights, targets = self.record.objective["weights"], self.record.objective["targets"]
        keys = (("latency", "latency_ms"), ("robot", "robot"), ("edge", "edge"))
        terms = [
            weights[weight] * value / targets[target]
            for value, (weight, target) in zip(shown, keys, strict=True)
        ]
        return float(sum(terms) + weights["switching"] * moved)

    def wants(self, row: Row) -> tuple[str, str]:
        set_to, now = self.parameters, self.now
        document = self.record.meta["problem"]
        size = 1
        if self.cost_answers:
            decision_ms = self.record.every * document["period_ms"]
            size = max(1, round(set_to["every_ms"] / decision_ms))
        stays = "dwell" if self.dwelt < set_to["min_dwell"] else "hold"
        self.seen.append(row)
        if len(self.seen) < size:
            return now, stays
        l95_ms, robot, edge = self.observed()
        home = now == set_to["local"]
        other = set_to["offload"] if home else set_to["local"]
        busy = robot > set_to["robot"] if home else edge > set_to["edge"]
        asked = l95_ms > set_to["latency_ms"] or busy
        moved = self.record.moved(now, other)
        saved = self.total(self.expected(now), 0.0) - self.total(self.expected(other), moved)
        cheaper = saved > self.margin(now, other) + GAIN_TOLERANCE
        self.begin()
        if stays == "hold" and asked and (cheaper or not self.cost_answers):
            return other, "migrate"
        return now, stays


class Answered(Thresholds):
    """ATP."""

    cost_answers = True


class Still(Rule):
    """A placement that never moves."""

    def wants(self, row: Row) -> tuple[str, str]:
        return self.now, "hold"


RULES: dict[str, type[Rule]] = {
    "dtp": Hysteresis,
    "atp": Answered,
    "atp-thresholds": Thresholds,
    "cusum": Sums,
    "work-function": Hindsight,
    "latency-first": Quickest,
    "SO": Still,
}


def derive(record: Record, rule: Rule) -> Iterator[tuple[Row, str, str]]:
    """Yield every row with the placement and the reason that follow from it."""
    for row in record.rows:
        assert row["dwell_cycles"] % record.every == 0
        assert row["dwell"] == row["dwell_cycles"] // record.width
        assert row["incumbent"] == rule.now or row["reason"] == "guard"
        if row[f"est_l95_ms_{rule.now}"] is None:
            yield row, row["placement"], "guard"
            rule.before, rule.now, rule.dwelt = row["incumbent"], row["placement"], 0
            rule.begin()
            continue
        priced(record, row)
        name, reason = rule.wants(row)
        yield row, name, reason
        rule.take(name)


def priced(record: Record, row: Row) -> None:
    """Hold what was recorded of every candidate against the formulas."""
    for name in record.names:
        over = record.over(row, name)
        excess = row[f"excess_{name}"]
        assert row[f"eligible_{name}"] is (excess is None or excess <= 0)
        # J may have a smaller L95 than the caps: one that is cut, or the age of a lost cycle.
        assert excess is None if over is None else excess >= over or excess == pytest.approx(over)
        J = record.cost(row, name, row["incumbent"])
        assert row[f"j_{name}"] == pytest.approx(J)


def require_derived(folder: Path, policy: str) -> Sequence[Row]:
    """Assert that every decision of a run follows from its tables; return the rows."""
    record = Record(folder)
    for row, name, reason in derive(record, RULES[policy](record, record.rows[0]["incumbent"])):
        assert (row["placement"], row["reason"]) == (name, reason), row
    return record.rows
