"""Prometheus metrics of a live cell, from an observer.

Names and units follow Prometheus' conventions. Values of labels are names from the cell file, its
certificates and the protocol, never text of a message. A series with an unknown value is absent,
not 0.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Literal, TypeAlias, get_args

from prometheus_client import Histogram, Metric
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector

from dwell.dash.observer import OUTCOMES, Observer
from dwell.live.failures import start_repeating
from dwell.live.roles.controlled_cell import MOVED_BY
from dwell.live.roles.health import Health
from dwell.live.wire.keys import CONTROLLER
from dwell.live.wire.wiring import roles
from dwell.model import Problem

Kind: TypeAlias = Literal["counter", "gauge", "info", "summary"]

#: Upper bounds of the latency histogram's buckets; the cell's deadline is another bound.
BUCKETS_S = (
    *(0.001, 0.002, 0.005, 0.01, 0.015, 0.02, 0.025, 0.03, 0.04, 0.05, 0.075, 0.1, 0.15, 0.2),
    *(0.3, 0.5, 1.0, 2.0, 5.0),
)
#: Time between two readings of the cycle feed, which keeps only the newest cycles.
EVERY_S = 2.0
#: Name and help text of the latency histogram.
LATENCY = (
    "dwell_cycle_latency_seconds",
    "Time from the release of a cycle to the completion of its last sink.",
)
#: Help text of each other metric, by kind.
SENTENCES: Mapping[Kind, Mapping[str, str]] = {
    "gauge": {
        "dwell_health": "1 for the current health of the cell, 0 for every other health.",
        "dwell_deadline_seconds": "Deadline of a cycle.",
        "dwell_guard_fallback": "Whether the guard chose the current placement.",
        "dwell_release_ratio": "Cycles released per period, over the time of three windows.",
        "dwell_violation_ratio": "Share of missed cycles among the cycles of the last decision.",
        "dwell_estimated_cost": "Estimated cost J of a candidate at the last decision.",
        "dwell_utilisation_ratio": "Utilisation of a resource over the cycles of the last "
        "decision, foreign work included.",
        "dwell_chain_age_seconds": "L95 of a chain's data age over the cycles of the last "
        "decision; infinite without an actuation.",
        "dwell_chain_age_missed_ratio": "Share of a chain's actuations in these cycles that are "
        "older than its max_age_ms.",
        "dwell_chain_reaction_seconds": "L95 of a chain's reaction times that end in these cycles; "
        "infinite without one.",
        "dwell_clock_bound_seconds": "Largest error of latencies in the last window due to the "
        "clocks.",
        "dwell_window_unproven": "Whether clock errors or lost messages leave the last window "
        "unproven.",
        "dwell_process_heard": "Whether the controller receives messages from a process of the "
        "cell.",
        "dwell_process_ready": "Whether a process can do its work; absent for silent processes.",
        "dwell_certificate_days": "Days until the certificate in use by a node or the controller "
        "ends; negative afterwards.",
        "dwell_certificate_expiry_timestamp_seconds": "Instant at which a subject's newest "
        "certificate ends.",
    },
    "summary": {
        "dwell_stage_seconds": "Time of a stage's jobs from start to end in the last window.",
    },
    "info": {
        "dwell_placement": "Placement of the newest cycle.",
        "dwell_task_placement": "Node of a task under the placement of the newest cycle.",
    },
    "counter": {
        "dwell_cycles": "Cycles since the start of the observer, by outcome.",
        "dwell_missed_cycles": "Missed cycles since the start of the observer.",
        "dwell_unread_cycles": "Cycles missing from dwell_cycle_latency_seconds because this "
        "process was too slow.",
        "dwell_silences": "Calls of hold() or zero() before an applied command, since the start of "
        "the controller.",
        "dwell_migrations": "Moves of the cell since the start of the controller, by reason, "
        "including the guard's moves.",
        "dwell_windows": "Ended windows of the run.",
        "dwell_stage_inputs": "Inputs of a stage since the creation of its state folder, by "
        "outcome.",
        "dwell_flow_bytes": "Payload bytes sent in a flow since the creation of its sender's state "
        "folder.",
    },
}
#: Suffix of a metric's name in its samples.
SUFFIXES: Mapping[Kind, str] = {"counter": "_total", "gauge": "", "info": "_info", "summary": ""}

#: Labels without the cell's, and the value; None if it is unknown.
Samples: TypeAlias = Iterable[tuple[Mapping[str, str], float | None]]


class CellMetrics(Collector):
    """Collector of the metrics of an observed cell.

    As a context manager it also counts cycles between two requests, every `EVERY_S`.

    Attributes
    ----------
    counted : int
        Position in the observer's feed of cycles.
    """

    def __init__(self, observer: Observer) -> None:
        self._observer, self._problem = observer, observer.problem
        self._members = [role.who for role in roles(self._problem) if role.kind != "controller"]
        self._deadline_s = self._problem.pipeline.deadline_ns / 1e9
        self._latency = Histogram(
            *LATENCY,
            ["cell"],
            buckets=sorted({*BUCKETS_S, self._deadline_s}),
            registry=None,
        )
        self.counted = self._unread = 0
        self._lock, self._stopped = threading.Lock(), threading.Event()

    def __enter__(self) -> CellMetrics:
        """Start the thread that counts cycles."""
        start_repeating("metrics", EVERY_S, self._stopped, self._count)
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the thread that counts cycles."""
        self._stopped.set()

    def page(self, accept: str) -> tuple[bytes, str]:
        """Return the metrics, as text or OpenMetrics by the `Accept` header, and the MIME type."""
        encode, content_type = choose_encoder(accept)
        return encode(self), content_type

    def collect(self) -> Iterator[Metric]:
        """Yield the current metrics."""
        self._count()
        yield from self._latency.collect()
        samples = self._samples()
        for kind, sentences in SENTENCES.items():
            for name, sentence in sentences.items():
                metric = Metric(name, sentence, kind)
                for labels, value in samples[name]:
                    if isinstance(value, int | float):
                        told = {"cell": self._problem.name, **labels}
                        metric.add_sample(f"{name}{SUFFIXES[kind]}", told, float(value))
                yield metric

    def _samples(self) -> dict[str, Samples]:
        now, problem = self._observer.now(), self._problem
        health, placement = now.status["health"], now.placement
        placed = problem.candidates.get(placement or "")
        sites = () if placed is None else placed.sites
        # Ignore the old status if the controller does not answer.
        status: Mapping[str, Any] = {} if health == "absent" else now.status
        window, moves, processes, stages, flows = (
            status.get(name) or {} for name in ("window", "moves", "processes", "stages", "flows")
        )
        estimates, used = window.get("estimates") or {}, window.get("utilisation") or {}
        bound_ms, resources = status.get("bound_ms"), problem.fabric.resources
        heard = {who: who in processes and processes[who]["heard"] for who in self._members}
        return {
            "dwell_health": [
                ({"health": one}, health == one) for one in get_args(Health) if health
            ],
            "dwell_deadline_seconds": [({}, self._deadline_s)],
            "dwell_guard_fallback": [({}, status.get("fallback"))],
            "dwell_release_ratio": [({}, status.get("release_ratio"))],
            "dwell_violation_ratio": [({}, window.get("violation_rate"))],
            "dwell_estimated_cost": [
                ({"placement": name}, estimates.get(name)) for name in problem.candidates
            ],
            "dwell_utilisation_ratio": [
                ({"node": one.node, "kind": one.kind or "cpu"}, used.get(name))
                for name, one in resources.items()
            ],
            **_chains(problem, window.get("ages") or {}),
            "dwell_clock_bound_seconds": [({}, None if bound_ms is None else bound_ms / 1e3)],
            "dwell_window_unproven": [({}, status.get("unproven"))],
            "dwell_stage_seconds": [
                ({**_stage(name), "quantile": quantile}, None if ms is None else ms / 1e3)
                for name, one in stages.items()
                for quantile, ms in (("0.5", one["exec_median_ms"]), ("0.95", one["exec_p95_ms"]))
            ],
            "dwell_process_heard": [({"process": who}, heard[who]) for who in heard if status],
            "dwell_process_ready": [
                ({"process": who}, processes[who]["ready"]) for who in heard if heard[who]
            ],
            "dwell_certificate_days": [
                ({"subject": name}, certificate["days"])
                for name, certificate in (status.get("certificates") or {}).items()
                if name in (*problem.fabric.nodes, CONTROLLER)
            ],
            "dwell_certificate_expiry_timestamp_seconds": self._certificates(),
            "dwell_placement": [({"placement": placement}, 1)] if sites else [],
            "dwell_task_placement": [({"task": task, "node": node}, 1) for task, node in sites],
            "dwell_cycles": [
                ({"outcome": one}, now.cycles.get(one, 0)) for one in OUTCOMES if now.cycles
            ],
            "dwell_missed_cycles": [({}, now.missed)] if now.cycles else [],
            "dwell_unread_cycles": [({}, self._unread)],
            "dwell_silences": [({}, status.get("silences"))],
            "dwell_migrations": [({"reason": one}, moves.get(one)) for one in MOVED_BY],
            "dwell_windows": [({}, status.get("windows"))],
            **_totals(stages, flows),
        }

    def _certificates(self) -> Samples:
        keyring = self._observer.security.keyring
        for subject in () if keyring is None else keyring.roster.subjects.values():
            yield {"subject": subject.name}, subject.ends.timestamp()

    def _count(self) -> None:
        """Count the new cycles of the feed."""
        with self._lock:
            news = self._observer.cycles.since(self.counted)
            self.counted, self._unread = news.upto, self._unread + news.dropped
            for cycle in news.items:
                if cycle.latency_ns is not None:
                    exemplar = {"run": str(cycle.run), "cycle": str(cycle.number)}
                    of_cell = self._latency.labels(self._problem.name)
                    of_cell.observe(cycle.latency_ns / 1e9, exemplar)


def _chains(problem: Problem, ages: Mapping[str, Any]) -> dict[str, Samples]:
    """Return the data ages and reaction times of the chains, from columns of ``windows``."""
    columns = {
        "dwell_chain_age_seconds": ("age_l95", 1e-3),
        "dwell_chain_age_missed_ratio": ("age_missed", 1.0),
        "dwell_chain_reaction_seconds": ("reaction_l95", 1e-3),
    }
    return {
        name: [
            ({"chain": chain}, ages[f"{column}_{chain}"] * factor)
            for chain in problem.pipeline.chains
            if f"{column}_{chain}" in ages
        ]
        for name, (column, factor) in columns.items()
    }


def _totals(stages: Mapping[str, Any], flows: Mapping[str, Any]) -> dict[str, Samples]:
    """Return the counts of the stages' inputs and the flows' bytes since their start."""
    return {
        "dwell_stage_inputs": [
            ({**_stage(name), "outcome": end}, count)
            for name, one in stages.items()
            for end, count in one["inputs_total"].items()
        ],
        "dwell_flow_bytes": [
            (dict(zip(("source", "target"), name.split("->"), strict=True)), one["bytes_total"])
            for name, one in flows.items()
        ],
    }


def _stage(name: str) -> dict[str, str]:
    """Return the labels of ``TASK@NODE``."""
    task, _, node = name.partition("@")
    return {"task": task, "node": node}
