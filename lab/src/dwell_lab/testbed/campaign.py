"""Campaign: repeated runs of every policy in every scenario, in random order.

A repetition is a block: every policy in every scenario once, shuffled. So slow drift (a warm
machine, load from other programs) affects all policies equally, and a stopped campaign is balanced
except for its last block. Runs of the same scenario and repetition share their seed and are
compared as pairs.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dwell.cellfile.sources import digest_of
from dwell.cellfile.study_paths import with_settings
from dwell.errors import LiveError, PolicyError, ProblemError
from dwell.live.local.trace_names import rename_traces
from dwell.model import Problem
from dwell.model.document import to_document
from dwell.policies.registry import by_name, estimates, estimator_of, names
from dwell.version import __version__
from dwell_lab.testbed.campaign_folder import TRACES

PAPERS_SCENARIOS = ("baseline", "robot-cpu-stress", "edge-cpu-stress", "network-impairment")
#: Parts of `dwell` and of this package that influence a measurement.
SOURCES = ("control", "cost.py", "estimators", "live", "model", "policies")
LABORATORY = ("testbed",)


class Entrant(NamedTuple):
    """A policy of a campaign with its estimator; `name` is used in tables: ``cusum+corrected``."""

    name: str
    policy: str
    estimator: str

    def problem(self, problem: Problem) -> Problem:
        """Return the cell with this policy and estimator."""
        seen = with_settings(problem, {"controller.estimator": self.estimator})
        return seen.under(self.policy)


class Planned(NamedTuple):
    """A run of a campaign.

    `place` and `repetition` count from 1, `policy` is an entrant's name, and `seed` is the same
    for all policies of a scenario and repetition.
    """

    place: int
    repetition: int
    scenario: str
    policy: str
    seed: int

    @property
    def name(self) -> str:
        """Name of the run's folder."""
        return re.sub(r"[^\w.+-]", "_", f"{self.place:04d}-{self.scenario}-{self.policy}")


@dataclass(frozen=True, slots=True)
class Campaign:
    """A measurement: every policy in every scenario, repeated.

    `seconds` is the length of each run with its warm-up, `seed` the seed of the order and of the
    runs, and `where` is ``testbed`` or a digest of the inventory of real hosts.

    Raises `ProblemError` if a scenario is unknown or the runs are too short for one window after
    the warm-up, `PolicyError` if a policy cannot be created for this cell, and `LiveError` if a
    list is empty or has duplicates.
    """

    problem: Problem
    scenarios: tuple[str, ...]
    entrants: tuple[Entrant, ...]
    repetitions: int
    seconds: float
    seed: int = 1
    where: str = "testbed"

    def __post_init__(self) -> None:
        names = tuple(one.name for one in self.entrants)
        for what, given in (("scenarios", self.scenarios), ("policies", names)):
            if not given:
                raise LiveError(f"{what} is empty; name at least one")
            twice = [name for i, name in enumerate(given) if name in given[:i]]
            if twice:
                raise LiveError(f"{what} holds {twice[0]!r} twice; name each once")
        if self.repetitions < 1:
            raise LiveError(f"repetitions is {self.repetitions}; it must be at least 1")
        for scenario in self.scenarios:
            self.problem.scenario(scenario)
        for one in self.entrants:
            by_name(one.policy, one.problem(self.problem))
        least = (self.problem.warmup_windows + 1) * self.problem.window_ms / 1e3
        if not self.seconds >= least:
            raise ProblemError(
                f"runs of {self.seconds:g} s are too short: warm-up and one window take {least:g} s"
            )

    def plan(self) -> tuple[Planned, ...]:
        """Return all runs in order: one block per repetition, each shuffled separately."""
        pairs = [(scenario, one.name) for scenario in self.scenarios for one in self.entrants]
        runs: list[Planned] = []
        for repetition in range(1, self.repetitions + 1):
            drawn = np.random.default_rng((self.seed, repetition)).permutation(len(pairs))
            for index in drawn:
                scenario, policy = pairs[index]
                seed = self.seed + repetition - 1
                runs.append(Planned(len(runs) + 1, repetition, scenario, policy, seed))
        return tuple(runs)

    @property
    def traces(self) -> dict[str, Path]:
        """Trace files of the cell, by their names in the campaign's folder."""
        folder = Path(self.problem.folder or "")
        return {kept: folder / name for name, kept in self._cell()[1].items()}

    def _cell(self) -> tuple[dict[str, Any], dict[str, str]]:
        """Return the cell as stored in the folder, and the stored name of each trace file."""
        document, names = to_document(self.problem), dict[str, str]()
        rename_traces(
            document,
            lambda name: names.setdefault(name, f"{TRACES}/{len(names) + 1}-{Path(name).name}"),
        )
        return document, names

    def describe(self) -> dict[str, Any]:
        """Return everything that the runs depend on, ready for JSON."""
        return {
            "software": {
                "dwell": __version__,
                "sources": digest_of(SOURCES) + digest_of(LABORATORY, "dwell_lab"),
            },
            "where": self.where,
            "scenarios": list(self.scenarios),
            "policies": {
                one.name: {"policy": one.policy, "estimator": one.estimator}
                for one in self.entrants
            },
            "repetitions": self.repetitions,
            "seconds": self.seconds,
            "seed": self.seed,
            "cell": self._cell()[0],
            "plan": [one._asdict() for one in self.plan()],
        }


def entrant(problem: Problem, name: str) -> Entrant:
    """Return the policy for a name of the command line.

    The name is a candidate, which never moves (``LOC``), a policy with the cell's estimator
    (``dtp``), or both (``cusum+corrected``). Policies without estimates use the profile unless the
    name sets an estimator.

    Raises `PolicyError` if the name is neither a policy nor a candidate of the cell.
    """
    policy, estimator = problem.policy_and_estimator(name)
    if policy not in names() and policy not in problem.candidates:
        by_name(policy, problem)
    if estimator is None:
        # The profile adds no shadow jobs to the nodes.
        blind = not estimates(policy) or policy in problem.candidates
        estimator = "profile" if blind else estimator_of(problem, policy)
    known = Entrant(name, policy, estimator)
    try:
        known.problem(problem)
    except ProblemError as error:
        raise PolicyError(f"policy {name!r}: {error.faults[0].message}") from None
    return known


def default_entrants(problem: Problem) -> tuple[Entrant, ...]:
    """Return every candidate, ATP, DTP, and CUSUM with corrected estimates."""
    names = (*problem.candidates, "atp", "dtp", "cusum+corrected")
    return tuple(entrant(problem, name) for name in names)


def default_scenarios(problem: Problem) -> tuple[str, ...]:
    """Return the cell's scenarios among the paper's four; all its scenarios if at most one is."""
    papers = tuple(name for name in PAPERS_SCENARIOS if name in problem.scenarios)
    return papers if len(papers) > 1 else tuple(problem.scenarios)
