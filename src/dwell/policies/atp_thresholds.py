"""ATPThresholds: moves one stage by thresholds alone, as the paper of DTP describes ATP.

According to Tran et al. (arXiv 2605.19887), ATP relocates a single stage, decides by binary
thresholds on individual metrics, and has no model of the cost of switching. The abstract of ATP's
own paper disagrees (see `dwell.policies.atp`). This module follows Tran et al., with the design
targets as thresholds.

* On the robot (`local`), the stage is offloaded if L95 or the robots' utilisation is above its
  threshold.
* Offloaded, it returns if L95 or the edge's utilisation is above its threshold.
* After a move it stays for at least `min_dwell` windows, counted as in DTP.

The rule reads the last window only and ignores estimates. If both sides exceed a threshold, it
alternates between them, and only the dwell limits the number of moves.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Self

from dwell.cost import TierUtilisation
from dwell.errors import PolicyError
from dwell.model.bounds import MIN_DWELL, Bound
from dwell.model.objective import Objective, Tier
from dwell.model.placement import Placement, plain_candidates
from dwell.model.problem import Problem
from dwell.model.qos import Decision, QoS
from dwell.policies.incumbent import PricingPolicy, check_name, check_parameter

THRESHOLD = Bound(0)


class Pair(NamedTuple):
    """Two candidates that differ in one task: on a robot, or on an edge or cloud node."""

    local: str
    offload: str
    task: str


def find_pairs(candidates: Mapping[str, Placement], tiers: Mapping[str, Tier]) -> tuple[Pair, ...]:
    """Return every pair of candidates that differ in the side of one task, in candidate order."""
    pairs = []
    plain = plain_candidates(candidates)
    for local, here in plain.items():
        for offload, there in plain.items():
            moved = here.moved(there)
            if len(moved) != 1:
                continue
            task = moved[0]
            outside = tiers.get(there.first[task]) in ("edge", "cloud")
            if tiers.get(here.first[task]) == "robot" and outside:
                pairs.append(Pair(local, offload, task))
    return tuple(pairs)


class ATPThresholds(PricingPolicy):
    """Toggles one task between a robot and the edge by thresholds (our reconstruction).

    Parameters
    ----------
    candidates : mapping of str to Placement
        Over the same tasks.
    initial : str, optional
        The candidate it starts on; the first if None. If it is neither `local` nor `offload`, the
        tier of the toggled task selects the side.
    objective : Objective
        Tiers of the nodes, and the thresholds that are not given.
    local, offload : str, optional
        Candidates that differ in exactly one task, on a robot in `local` and on the edge or in
        the cloud in `offload`. If None, the first pair that contains `initial`, else the first
        pair.
    latency_ms : float, optional
        Threshold on L95, milliseconds; ``targets.latency_ms`` if None.
    robot, edge : float, optional
        Thresholds on U_r and U_e, infinity for none; ``targets.robot`` and ``targets.edge`` if
        None. If the objective weighs cloud nodes separately and the task is offloaded to a cloud
        node, `edge` is the threshold on U_c and defaults to ``targets.cloud``.
    min_dwell : int
        Windows without a migration after each migration.

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
        outside_tier = objective.tiers[self.candidates[self.pair.offload].first[self.pair.task]]
        #: Whether the task is offloaded to a cloud node that the objective weighs separately.
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
        """Make a policy that toggles the heaviest task, preferably from the initial candidate.

        Raises
        ------
        PolicyError
            If no two candidates differ in exactly one task.
        """
        pairs = find_pairs(problem.candidates, problem.objective.tiers)

        def robot_time_ms(pair: Pair) -> float:
            task = problem.pipeline.tasks[pair.task]
            on_robot = task.on[problem.candidates[pair.local].first[pair.task]]
            scale = 1.0 if task.scale is None else problem.pipeline.scales[task.scale].expectation
            return on_robot.exec_ms.expectation * scale

        # Offloading the heaviest stage saves most; of equal pairs max() returns the first.
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
        """Return the first pair that matches the arguments, preferably with `initial`.

        Raises
        ------
        PolicyError
            If no pair matches.
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
                f"one and on an edge or cloud node in the other; no pair{asked} "
                f"qualifies among {', '.join(self.candidates)}: add a candidate, or use another "
                "policy"
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
        """Return the other side of the pair, and whether a metric exceeds its threshold."""
        task = self.pair.task
        if self.objective.tiers.get(self.candidates[self.incumbent].first[task]) == "robot":
            other, busy = self.pair.offload, used.robot > self.robot
        else:
            outside = used.cloud if self.on_cloud else used.edge
            other, busy = self.pair.local, outside > self.edge
        return other, l95_ms > self.latency_ms or busy
