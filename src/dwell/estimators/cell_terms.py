"""Cell terms: J of a cell without the nodes that cells share, and the cost of these nodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dwell.cost import price, tier_nodes, weighed
from dwell.model.problem import Problem
from dwell.model.qos import QoS


class CellTerms:
    """Terms of a cell's J: its own terms, and the terms of shared nodes.

    `resources` are all resources of the cell, `of_shared` the resources of shared nodes.
    """

    def __init__(self, problem: Problem, shared: Sequence[str]) -> None:
        self.resources = tuple(problem.fabric.resources)
        self._objective = objective = problem.objective
        # J is linear in U_r, U_e and U_c.
        factors: list[float] = [
            price(0.0, 0.0, robot, edge, cloud, 0.0, objective)
            for robot, edge, cloud in np.eye(3).tolist()
        ]
        self._capacity = {name: one.capacity for name, one in problem.fabric.resources.items()}
        node_of = {name: one.node for name, one in problem.fabric.resources.items()}
        self.of_shared = {name for name, node in node_of.items() if node in shared}
        self._own, self._shared = [], []
        for factor, names in zip(factors, tier_nodes(objective), strict=True):
            self._own.append([name for name in names if name not in self.of_shared])
            # The fullest resource of a shared node counts, accelerators included.
            for node in shared:
                here = [name for name in names if node_of[name] == node]
                if here:
                    self._shared.append((factor, here))

    def cost(self, qos: QoS) -> float:
        """J without switching and shared nodes."""
        robot, edge, cloud = (_most(names, qos.utilisation) for names in self._own)
        metrics, objective = (qos.l95_ms, qos.violation_rate, robot, edge, cloud), self._objective
        return float(price(*metrics, 0.0, objective, *weighed(qos, objective)))

    def of_one(self) -> dict[str, float]:
        """Return the cost to the cell of one busy core, or place, of each shared resource."""
        return {
            name: factor / self._capacity[name] for factor, names in self._shared for name in names
        }

    def shared_cost(self, used: Mapping[str, float]) -> float:
        """Return the cost to the cell of the utilisation of shared nodes."""
        return sum(factor * _most(names, used) for factor, names in self._shared)


def _most(names: Sequence[str], used: Mapping[str, float]) -> float:
    """Return the utilisation of the fullest resource; unknown resources count as 0."""
    return max((used.get(name, 0.0) for name in names), default=0.0)
