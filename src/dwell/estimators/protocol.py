"""What an estimator is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

from dwell.model.qos import QoS

__all__ = ["Estimator"]


@runtime_checkable
class Estimator(Protocol):
    """Predicts the QoS of every candidate from what a window showed under the incumbent."""

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        """Estimate every candidate's metrics for the window just seen.

        Parameters
        ----------
        observed : QoS
            Metrics of the window.
        incumbent : str
            The candidate it ran under; its entry is an estimate like the others.
        own : mapping of str to float
            Share of each node's cores that the cell's own work took in the window; the rest of
            the observed utilisation is foreign load.

        Returns
        -------
        mapping of str to QoS
            One entry for each candidate.

        Raises
        ------
        MetricError
            If a node's utilisation is missing.
        """
        ...
