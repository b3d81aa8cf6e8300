"""A measured campaign: its runs as a comparison, and the times of its jobs and messages.

A repetition takes the place of a seed: one run gives one number, and the runs of one scenario and
repetition are a pair. Windows that were measured under pressure are left out, with their cycles.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dwell.cellfile import from_document
from dwell.control.windows import busiest
from dwell.errors import RunError
from dwell.model import Problem
from dwell.record import Run, arrays_of, open_run
from dwell.study.comparison import Comparison
from dwell.study.player import Example
from dwell.study.summary import Row, latency_grid_ms, summarise, used_in
from dwell_lab.testbed.campaign_folder import CampaignFolder, read_campaign
from dwell_lab.validation.job_times import jobs_of, links_of, profiles_of
from dwell_lab.validation.measured_run import excluded_windows

if TYPE_CHECKING:
    import polars as pl


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredCampaign:
    """The contents of a campaign's folder.

    Parameters
    ----------
    comparison : Comparison
        The comparison of its runs; repetitions are the seeds.
    estimators : mapping of str to str
        By policy.
    kinds : frozenset of str
        ``live``, or ``simulated`` if the runs were simulated.
    where : str
        ``testbed``, or the inventory.
    seconds : float
        Length of each run.
    planned : int
        Runs of the campaign, done or not.
    log : DataFrame
        One row per finished run, in their order: ``place``, ``repetition``, ``scenario``,
        ``policy``, ``attempt``, ``began_unix_s``, ``idle``, ``waited_s``, ``windows``, ``excluded``
        (the last two after the warm-up).
    failed : DataFrame
        One row per failed attempt: ``scenario``, ``policy``, ``repetition``, ``attempt``,
        ``outcome``, ``reason``.
    profiles : DataFrame
        One row per task and node: times of its jobs in the baseline, see
        `dwell_lab.validation.job_times`.
    links : DataFrame
        One row per scenario, link and flow: delays of its messages.
    delays : DataFrame
        Distribution of these: ``share`` of the messages within ``delay_ms``, by ``scenario`` and
        ``link``.
    windows : DataFrame
        Every window that counts: ``scenario``, ``policy``, ``l95_ms``, ``violation_rate``,
        ``u_robot``, ``u_edge``.
    """

    comparison: Comparison
    estimators: Mapping[str, str]
    kinds: frozenset[str]
    where: str
    seconds: float
    planned: int
    log: pl.DataFrame
    failed: pl.DataFrame
    profiles: pl.DataFrame
    links: pl.DataFrame
    delays: pl.DataFrame
    windows: pl.DataFrame

    @property
    def repetitions(self) -> int:
        """Number of complete repetitions."""
        pairs = len(self.comparison.scenarios) * len(self.comparison.policies)
        counts = self.log.group_by("repetition").len()
        return int((counts["len"] == pairs).sum())


def read_measured(folder: Path) -> MeasuredCampaign:
    """Read a campaign, finished or not.

    Raises
    ------
    RunError
        If the folder holds none, or none of its runs is done.
    """
    import polars as pl

    kept, problem = _begun(folder)
    described = kept.description
    rows: list[Row] = []
    costs: list[Row] = []
    logged: list[dict[str, Any]] = []
    within: dict[tuple[str, str], Any] = {}
    examples: dict[tuple[str, str], Example] = {}
    windows, jobs, versions, kinds = [], [], {}, set()
    for path, record in kept.done.items():
        run = open_run(path)
        scenario, policy = str(record["scenario"]), str(record["policy"])
        counted = without_excluded(run, problem)
        repetition = int(record["repetition"])
        summary = summarise(
            counted, problem, {"scenario": scenario, "policy": policy, "seed": repetition}
        )
        rows.append(summary.row)
        costs += summary.costs
        within[scenario, policy] = within.get((scenario, policy), 0) + summary.within
        examples.setdefault((scenario, policy), Example(run.windows, run.decisions))
        logged.append(_logged(record, run, counted))
        windows.append(_windows(counted, problem, scenario, policy))
        if run.has_jobs:
            jobs.append(jobs_of(counted, scenario, policy, len(rows)))
        kinds.add(str(run.meta.get("kind", "simulated")))
        versions = dict(run.meta.get("versions", {}))
    runs = _in_order(pl.DataFrame(rows, infer_schema_length=None).sort("seed"), described)
    comparison = Comparison(
        name=problem.name,
        problem=problem,
        scenarios=tuple(one for one in described["scenarios"] if one in set(runs["scenario"])),
        policies=tuple(one for one in described["policies"] if one in set(runs["policy"])),
        seeds=tuple(sorted(set(runs["seed"]))),
        windows=int(runs["windows"].max()) + problem.warmup_windows,  # type: ignore[arg-type]
        runs=runs,
        costs=pl.DataFrame(costs, infer_schema_length=None),
        latencies=_latencies(runs, within, problem),
        examples=examples,
        versions=versions,
    )
    every = _in_order(pl.concat(jobs, how="diagonal_relaxed"), described) if jobs else None
    links, delays = links_of(every, problem)
    return MeasuredCampaign(
        comparison=comparison,
        estimators={name: one["estimator"] for name, one in described["policies"].items()},
        kinds=frozenset(kinds),
        where=str(described["where"]),
        seconds=float(described["seconds"]),
        planned=len(described["plan"]),
        log=pl.DataFrame(logged, infer_schema_length=None),
        failed=_failed(kept),
        profiles=profiles_of(every, problem),
        links=links,
        delays=delays,
        windows=pl.concat(windows),
    )


def _begun(folder: Path) -> tuple[CampaignFolder, Problem]:
    """Read a campaign and its cell; raise a RunError if none of its runs is done."""
    kept = read_campaign(folder)
    described = kept.description
    if not kept.done:
        raise RunError(f"{folder}: none of its {len(described['plan'])} runs is done yet")
    source = str(folder)
    return kept, from_document(described["cell"], folder=folder, source=source, is_record=True)


def without_excluded(run: Run, problem: Problem) -> Run:
    """Return a run without the windows that were measured under pressure, and their cycles.

    Ages at the actuator and tracking errors of the rest are invalid: they accumulate across the
    gaps.

    """
    import polars as pl

    excluded = sorted(excluded_windows(run.meta))
    if not excluded:
        return run
    kept = ~pl.col("window").is_in(excluded)
    left = run.windows.filter(~kept)["first_cycle"].to_numpy()
    numbers = (left[:, None] + np.arange(problem.window_cycles)).ravel()
    tables = {
        "cycles": run.cycles.filter(~pl.col("cycle").is_in(numbers)),
        "windows": run.windows.filter(kept),
        "decisions": run.decisions,
    }
    if run.has_jobs:
        tables["jobs"] = run.jobs.filter(~pl.col("cycle").is_in(numbers))
    return Run(run.meta, tables)


def _logged(record: Mapping[str, Any], run: Run, counted: Run) -> dict[str, Any]:
    windows, left = (int((~one.windows["warmup"]).sum()) for one in (run, counted))
    names = ("place", "repetition", "scenario", "policy", "attempt", "began_unix_s")
    return {
        **{name: record[name] for name in names},
        "idle": bool(record["idle"]["idle"]),
        "waited_s": float(record["idle"]["waited_s"]),
        "windows": windows,
        "excluded": windows - left,
    }


def _failed(kept: CampaignFolder) -> pl.DataFrame:
    import polars as pl

    names = ("scenario", "policy", "repetition", "attempt", "outcome", "reason")
    rows = [{name: record.get(name) for name in names} for record in kept.failed]
    kinds = dict.fromkeys(names, pl.String) | {"repetition": pl.Int64, "attempt": pl.Int64}
    return pl.DataFrame(rows, schema=kinds)


def _in_order(rows: pl.DataFrame, described: Mapping[str, Any]) -> pl.DataFrame:
    """Sort rows by scenario and policy, in the order in which the campaign names them."""
    import polars as pl

    scenarios, policies = list(described["scenarios"]), list(described["policies"])
    return rows.sort(
        pl.col("scenario").replace_strict(scenarios, list(range(len(scenarios)))),
        pl.col("policy").replace_strict(policies, list(range(len(policies)))),
        maintain_order=True,
    )


def _latencies(
    runs: pl.DataFrame, within: Mapping[tuple[str, str], Any], problem: Problem
) -> pl.DataFrame:
    """Distribution of the latency of all cycles that count, by scenario and policy."""
    import polars as pl

    grid_ms = latency_grid_ms(problem.pipeline.deadline_ms)
    parts = []
    for (scenario, policy), group in runs.group_by("scenario", "policy", maintain_order=True):
        share = within[str(scenario), str(policy)] / group["cycles"].sum()
        points = pl.DataFrame({"latency_ms": grid_ms, "share": share})
        parts.append(points.select(pl.all(), scenario=pl.lit(scenario), policy=pl.lit(policy)))
    return pl.concat(parts).select("scenario", "policy", "latency_ms", "share")


def _windows(run: Run, problem: Problem, scenario: str, policy: str) -> pl.DataFrame:
    """Return the windows that count, with the busiest of each tier."""
    import polars as pl

    windows = run.windows.filter(~pl.col("warmup"))
    robot, edge, _ = busiest(used_in(arrays_of(windows), problem), problem)
    return windows.select(
        scenario=pl.lit(scenario),
        policy=pl.lit(policy),
        l95_ms="seen_l95_ms",
        violation_rate="seen_violation_rate",
        u_robot=pl.Series(robot, nan_to_null=True),
        u_edge=pl.Series(edge, nan_to_null=True),
    )
