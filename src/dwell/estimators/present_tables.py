"""Present tables: the measured conditions of a cell in the kernel's tables."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from dwell.estimators.measured import Message, Part, Site, cores_of
from dwell.estimators.present import Present
from dwell.kernels.arrays import Arrays
from dwell.kernels.codes import LAST_NS
from dwell.kernels.pools import TimesRow, fill
from dwell.kernels.realisation import Realisation
from dwell.model.number_arrays import Floats
from dwell.model.problem import Problem

#: Number of cycles after a step that may already be released when it ends.
BEYOND = 64


class PresentTables:
    """Writes the measured conditions of a cell into tables.

    `drawn` has a declared realisation and its copy in the tables, for the cell and for its shadows.
    `changes` are the changes of the cell's nodes. The first cell has the changes of shared nodes.
    """

    def __init__(
        self,
        problem: Problem,
        arrays: Arrays,
        index: int,
        shared: Collection[str],
        drawn: Sequence[tuple[Realisation, Realisation]],
    ) -> None:
        part, tables, (real, _) = arrays.parts[index], arrays.tables, drawn[0]
        fabric, resource_0 = problem.fabric, int(tables.cells["resource_0"][part.row])
        servers = tables.cell_servers[resource_0 : resource_0 + part.resources]
        rows = dict(zip(fabric.resources, tables.servers["node"][servers].tolist(), strict=True))
        self._nodes = {name: rows[name] for name in fabric.nodes if not index or name not in shared}
        self._release_ns = real.release_ns
        own = np.isin(tables.changes["node"], [*self._nodes.values()])
        self.changes = tables.changes[own & (tables.changes["at_ns"] < LAST_NS)]
        self._declared_changes = self.changes
        self._nothing_ns = np.zeros(real.cycles, np.int64)
        hops = list(enumerate(real.hops, part.hop_0))
        rates, every = problem.pipeline.rates, problem.pipeline.message_rates
        #: Extra delays of each message, and of its shadows.
        self._layers = {
            Message(*hop): tables.layers[row :: len(hops) + len(real.forwards)][: part.rows]
            for row, hop in hops
        }
        links = {hop[2]: tables.links[tables.hops["link"][row]].tolist()[-2:] for row, hop in hops}
        self._rates = {link: tables.rates[slice(*row)] for link, row in links.items()}
        self._segments = {link: tables.segments[slice(*row)] for link, row in links.items()}
        self._repeats = {link for link in links if fabric.links[link].retransmit_ms is not None}
        views = [*self._layers.values(), *self._rates.values(), *self._segments.values()]
        #: Tables with the declared values to restore.
        self._declared = [(view, view.copy()) for view in views]
        self._rows: dict[Part, list[TimesRow]] = {}
        for declared, played in drawn:
            self._declared += [(played.exec_ns, declared.exec_ns)]
            self._declared += [(played.delay_ns, declared.delay_ns)]
            for site, row in zip(played.sites, played.exec_ns, strict=True):
                of_site = self._rows.setdefault(Site(*site), [])
                of_site.append(TimesRow.of(row, rates[site[0]]))
            # The rows of forwards come after.
            for hop, row in zip(played.hops, played.delay_ns, strict=False):
                of_hop = self._rows.setdefault(Message(*hop), [])
                of_hop.append(TimesRow.of(row, every.get(hop[:2], 1)))
        self._stretched: dict[Part, float] = {
            Site(*site): _stretched(problem, Site(*site)) for site in real.sites
        }
        #: Demands in the tables.
        self._filled: Mapping[Part, Floats] = {}

    def begin(self, present: Present) -> None:
        """Restore the declared values, and write measured conditions."""
        for table, declared in self._declared:
            np.copyto(table, declared)
        self.changes = present.changes(self._declared_changes, self._nodes, self._release_ns)
        for part in present.demands:
            # Measured delays include the extra delays of their link.
            if isinstance(part, Message) and part in self._layers:
                layers = self._layers[part]
                layers[layers != 0] = self._nothing_ns.ctypes.data
        for link, mbps in present.rates_mbps.items():
            self._rates[link]["rate_mbps"] = mbps
        self._set_losses(present)
        self.fill(present)

    def grow(self, present: Present, since: int, offset: int) -> None:
        """Write newer values of the same parts (see `fill`)."""
        self._set_losses(present)
        self.fill(present, since, offset)

    def fill(self, present: Present, since: int = 0, offset: int = 0) -> None:
        """Write the demands of the cycles from `since` on, except cycles just released.

        `offset` is the number of the first cycle.
        """
        begin = since + BEYOND if since else 0
        for part, values in present.demands.items():
            # An earlier call has written the same values, up to the last cycle.
            if since and self._filled.get(part) is values:
                continue
            stretched = self._stretched.get(part, 1.0)
            fill(self._rows.get(part, ()), values, stretched, begin, offset)
        self._filled = present.demands

    def _set_losses(self, present: Present) -> None:
        """Set the share of messages that each link loses."""
        for link, share in present.lost.items():
            if link not in self._repeats:
                self._rates[link]["loss"] = share
            else:
                # Delays include lost attempts. A link that loses half its messages is down.
                self._rates[link]["loss"] = 0.0
                self._segments[link]["is_down"] = share >= 0.5


def _stretched(problem: Problem, site: Site) -> float:
    """Return the threads per core of a job that has more threads than cores; else 1."""
    execution = problem.pipeline.tasks[site.task].on[site.node]
    if execution.accelerator is not None:
        return 1.0
    return execution.threads / cores_of(problem.fabric.nodes[site.node], execution)
