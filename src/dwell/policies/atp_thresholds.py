"""ATPThresholds: one stage moved by thresholds alone, as the paper of DTP describes its forerunner.

Tran et al. (arXiv 2605.19887) say of ATP that it relocates a single stage, decides by binary
thresholds on individual metrics, and has no model of the cost of switching. The abstract of the
paper of ATP itself says otherwise (see `dwell.policies.atp`). This is the rule of the first, with
thresholds of our own: the design targets.

* On the robot (`local`), the stage is offloaded if L95 or the robots' utilisation is above its
  threshold.
* Offloaded, it returns if L95 or the edge's utilisation is above its threshold.
* After a move it stays for at least `min_dwell` windows, counted as in DTP.

It looks at the last window only, and never asks what the other side would have shown: where both
sides are over a threshold it moves to and fro, held back by the dwell alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Self

from dwell.cost import TierUtilisation
from dwell.errors import PolicyError
from dwell.model.bounds import MIN_DWELL, Bound
from dwell.model.objective import Objective, Tier
from dwell.model.placement import Placement
from dwell.model.problem import Problem
from dwell.model.qos import Decision, QoS
from dwell.policies.incumbent import PricingPolicy, check_name, check_parameter

THRESHOLD = Bound(0)


class Pair(NamedTuple):
    """Two candidates that differ in where one task runs: on a robot, or on the edge or cloud."""

    local: str
    offload: str
    task: str


def find_pairs(candidates: Mapping[str, Placement], tiers: Mapping[str, Tier]) -> tuple[Pair, ...]:
    """Return every pair of candidates that one task could toggle between, in their order."""
    pairs = []
    for local, here in candidates.items():
        for offload, there in candidates.items():
            moved = here.moved(there)
            if len(moved) != 1:
                continue
            task = moved[0]
            outside = tiers.get(there[task]) in ("edge", "cloud")
            if tiers.get(here[task]) == "robot" and outside:
                pairs.append(Pair(local, offload, task))
    return tuple(pairs)


class ATPThresholds(PricingPolicy):
    """Toggles one task between a robot and the edge by thresholds (our reconstruction).

    Parameters
    ----------
    candidates : mapping of str to Placement
        Over the same tasks.
    initial : str, optional
        The candidate it starts on; the first where None. On one that is neither `local` nor
        `offload`, the side it is on is that of the toggled task's tier.
    objective : Objective
        Tiers of the nodes, and the thresholds that are not given.
    local, offload : str, optional
        Candidates that differ in exactly one task, on a robot in `local` and on the edge or in
        the cloud in `offload`. Where None, the first pair that contains `initial`, else the
        first pair.
    latency_ms : float, optional
        Threshold on L95, milliseconds; ``targets.latency_ms`` where None.
    robot, edge : float, optional
        Thresholds on U_r and U_e, infinity for none; ``targets.robot`` and ``targets.edge``
        where None. Where the objective weighs cloud nodes apart and the task is offloaded to one,
        `edge` is a threshold on U_c, and ``targets.cloud`` where None.
    min_dwell : int
        Windows after a migration that never migrate.

    Raises
    ------
    PolicyError
        If a parameter is out of its range, a name is no candidate, candidates place different
        tasks, or no two candidates make a pair.
    """

    # It reads no estimates.
    usual_estimator = "profile"

    def __init__(
        self,
        *,
        candidates: Mapping[str, Placement],
        initial: str | None = None,
        objective: Objective,
        local: str | None = None,
        offload: str | None = None,
        latency_ms: float | None = None,
        robot: float | None = None,
        edge: float | None = None,
        min_dwell: int = 3,
    ) -> None:
        super().__init__(candidates=candidates, initial=initial, objective=objective)
        self.min_dwell = check_parameter("min_dwell", min_dwell, MIN_DWELL)
        self.pair = self._choose(local, offload)
        targets = objective.targets
        outside_tier = objective.tiers[self.candidates[self.pair.offload][self.pair.task]]
        #: Whether the task is offloaded to a cloud node that the objective weighs apart.
        self.on_cloud = objective.weights.cloud is not None and outside_tier == "cloud"
        outside = targets.cloud if self.on_cloud and targets.cloud else targets.edge
        self.latency_ms = targets.latency_ms if latency_ms is None else latency_ms
        self.robot = targets.robot if robot is None else robot
        self.edge = outside if edge is None else edge
        check_parameter("latency_ms", self.latency_ms, THRESHOLD)
        check_parameter("robot", self.robot, THRESHOLD)
        check_parameter("edge", self.edge, THRESHOLD)

    @classmethod
    def from_problem(cls, problem: Problem) -> Self:
        """Make a policy that toggles one task: the heaviest, of pairs with the initial candidate.

        Raises
        ------
        PolicyError
            If no two candidates differ in exactly one task.
        """
        pairs = find_pairs(problem.candidates, problem.objective.tiers)

        def robot_time_ms(pair: Pair) -> float:
            task = problem.pipeline.tasks[pair.task]
            on_robot = task.on[problem.candidates[pair.local][pair.task]]
            scale = 1.0 if task.scale is None else problem.pipeline.scales[task.scale].expectation
            return on_robot.exec_ms.expectation * scale

        # The heaviest stage is the one worth offloading; max() keeps the first of equals.
        pair = max(
            pairs,
            key=lambda pair: (problem.initial in pair[:2], robot_time_ms(pair)),
            default=None,
        )
        return cls(
            candidates=problem.candidates,
            initial=problem.initial,
            objective=problem.objective,
            local=pair.local if pair else None,
            offload=pair.offload if pair else None,
            min_dwell=problem.min_dwell_decisions,
        )

    def __repr__(self) -> str:
        return (
            f"ATPThresholds(initial={self.initial!r}, local={self.pair.local!r}, "
            f"offload={self.pair.offload!r}, min_dwell={self.min_dwell})"
        )

    def _choose(self, local: str | None, offload: str | None) -> Pair:
        """Return the first pair that agrees with what is given, one with `initial` before others.

        Raises
        ------
        PolicyError
            If there is none.
        """
        for field, name in (("local", local), ("offload", offload)):
            if name is not None:
                check_name(field, name, self.candidates)
        pairs = [
            pair
            for pair in find_pairs(self.candidates, self.objective.tiers)
            if local in (None, pair.local) and offload in (None, pair.offload)
        ]
        if not pairs:
            asked = f" with local={local!r}, offload={offload!r}" if local or offload else ""
            raise PolicyError(
                f"atp needs two candidates that differ in exactly one task, on a robot node in "
                f"one and on an edge or cloud node in the other; there is no such pair{asked} "
                f"among {', '.join(self.candidates)}: add a candidate, or use another policy"
            )
        return next((pair for pair in pairs if self.initial in pair[:2]), pairs[0])

    @property
    def local(self) -> str:
        """The candidate with the task on a robot."""
        return self.pair.local

    @property
    def offload(self) -> str:
        """The candidate with the task on the edge or in the cloud."""
        return self.pair.offload

    def _decide(
        self, observed: QoS, estimates: Mapping[str, QoS] | None
    ) -> tuple[Decision, object]:
        """Toggle the task if a metric of the window is above its threshold."""
        used = self._pricing.used(observed)
        costs = self._costs(estimates)
        if self._standing.dwell < self.min_dwell:
            return self._stay("dwell", costs), None
        other, over = self._question(observed.l95_ms, used)
        return (self._move(other, "migrate", costs) if over else self._stay("hold", costs)), None

    def _question(self, l95_ms: float, used: TierUtilisation) -> tuple[str, bool]:
        """Return the other side of the pair, and whether a metric is above its threshold here."""
        task = self.pair.task
        if self.objective.tiers.get(self.candidates[self.incumbent][task]) == "robot":
            other, busy = self.pair.offload, used.robot > self.robot
        else:
            outside = used.cloud if self.on_cloud else used.edge
            other, busy = self.pair.local, outside > self.edge
        return other, l95_ms > self.latency_ms or busy
