"""Runs by seed over examples, scenarios, policies and estimators, as digests of their tables."""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

import polars as pl

import dwell
from dwell.estimators.registry import REGISTRY as ESTIMATORS
from dwell.model import Problem
from dwell.model.controller_settings import REPLICATE
from dwell.model.evolve import evolve
from dwell.policies.registry import REGISTRY as POLICIES

ROOT = Path(__file__).parents[2]
DATA = Path(__file__).parent / "data"
EXAMPLES = ("canonical", "fan-in", "cloud", "live/cell", "visual_servoing/testbed")
#: Cells that are played as they are, with the defaults of all settings that their files leave out.
DEFAULTS = ("defaults/first", "defaults/live/cell", "defaults/visual_servoing/testbed")
#: N_min and share of shadows where they are not 3 and 0.05.
SETTINGS = {"visual_servoing/testbed": (2, 0.1)}
TABLES = ("cycles", "windows", "decisions")
#: Windows beyond the warm-up.
WINDOWS = 7
#: Decimals of floats that are compared: computers differ in the last bits.
DECIMALS = 6


class Case(NamedTuple):
    """What is played: all of it, and a guard where the cell has one.

    An empty policy or estimator is the cell's.
    """

    scenario: str
    policy: str
    estimator: str
    guard: str
    seed: str


def cases(problem: Problem) -> Iterator[Case]:
    """Yield every scenario with every candidate, and every policy with every estimator."""
    guards = ("no", "yes") if problem.controller.fallbacks else ("no",)
    for scenario in problem.scenarios:
        for guard in guards:
            for name in problem.candidates:
                yield Case(scenario, name, "profile", guard, "1")
            estimators = ESTIMATORS if guard == "no" else ("corrected",)
            # These cells have no replicas: `replicate` is as its base.
            for policy in (name for name in POLICIES if name != REPLICATE):
                for estimator in estimators:
                    yield Case(scenario, policy, estimator, guard, "1")


def cases_of_defaults(problem: Problem) -> Iterator[Case]:
    """Yield every scenario with two seeds."""
    guard = "yes" if problem.controller.fallbacks else "no"
    for scenario in problem.scenarios:
        for seed in "12":
            yield Case(scenario, "", "", guard, seed)


@cache
def load(example: str) -> Problem:
    """Return an example's cell, if not of `DEFAULTS` with one decision per window and a dwell."""
    path = f"{example.removeprefix('defaults/')}.yaml"
    problem = dwell.load(ROOT / "examples" / path)
    if example in DEFAULTS:
        return problem
    least, fraction = SETTINGS.get(example, (3, 0.05))
    settings = {
        "controller.decide_cycles": problem.window_cycles,
        "controller.min_dwell": least,
        "controller.shadow_fraction": fraction,
    }
    return evolve(problem, settings)


def play(example: str, case: Case, columns: Mapping[str, list[str]]) -> dict[str, str]:
    """Play a case; returns its digests and some numbers that tell what has changed.

    Parameters
    ----------
    example : str
    case : Case
    columns : mapping of str to list of str
        Which columns of each table count: new ones do not.
    """
    problem = load(example)
    run = dwell.simulate(
        problem,
        scenario=case.scenario,
        policy=case.policy or None,
        estimator=case.estimator or None,
        seed=int(case.seed),
        windows=problem.warmup_windows + WINDOWS,
        guard=case.guard == "yes",
    )
    windows, decisions = run.windows, run.decisions
    counted = run.cycles[: run.last_window_end]
    return {
        **{table: digest(getattr(run, table), columns[table]) for table in TABLES},
        "lost": str(counted.filter(pl.col("outcome") != "done").height),
        "violation_rate": f"{_number(windows['violation_rate'].mean()):.4f}",
        "l95_ms": f"{_number(windows['seen_l95_ms'].median()):.3f}",
        "moves": str(decisions["migrated"].sum()),
        "ends_at": str(windows["placement"][-1]),
    }


def _number(value: object) -> float:
    assert isinstance(value, float)
    return value


def digest(table: pl.DataFrame, columns: list[str]) -> str:
    """Return a digest of a table: floats to six places, everything else exactly."""
    found = hashlib.sha256()
    for name in columns:
        if name not in table.columns:
            continue
        column = table[name]
        if column.dtype.is_float():
            # Adding zero takes the sign from one that is negative.
            values = [None if value is None else round(value, DECIMALS) + 0.0 for value in column]
        else:
            values = column.cast(pl.String).to_list()
        found.update(f"{name}:{values}\n".encode())
    return found.hexdigest()[:16]


# ------------------------------------------------------------------------------------ the files


def _files(example: str) -> tuple[Path, Path]:
    name = example.replace("/", "-")
    return DATA / f"runs-{name}.csv", DATA / f"columns-{name}.json"


def read(example: str) -> tuple[dict[Case, dict[str, str]], dict[str, list[str]]]:
    """Return what was written down: the cases with their digests, and the columns that count."""
    runs, columns = _files(example)
    with runs.open(newline="") as file:
        rows = list(csv.DictReader(file))
    cases = {Case(*(row.pop(field) for field in Case._fields)): row for row in rows}
    return cases, json.loads(columns.read_text())


def write(example: str) -> int:
    """Write an example's cases down; returns how many."""
    runs, columns = _files(example)
    problem = load(example)
    known: dict[str, dict[str, None]] = {table: {} for table in TABLES}
    for estimator in ESTIMATORS:
        run = dwell.simulate(
            problem,
            policy="dtp",
            estimator=estimator,
            seed=1,
            windows=problem.warmup_windows + WINDOWS,
        )
        for table in TABLES:
            known[table] |= dict.fromkeys(getattr(run, table).columns)
    told = {table: list(names) for table, names in known.items()}
    columns.write_text(json.dumps(told, indent=1) + "\n")
    which = cases_of_defaults if example in DEFAULTS else cases
    rows = [{**case._asdict(), **play(example, case, told)} for case in which(problem)]
    with runs.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return len(rows)
