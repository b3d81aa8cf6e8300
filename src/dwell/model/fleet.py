"""Fleet: several cells that share nodes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import Literal, TypeAlias, get_args

from dwell.errors import Fault, ProblemError
from dwell.model.bounds import Bound
from dwell.model.declaration import declared, declared_fields, key
from dwell.model.fabric import Node
from dwell.model.problem import Problem
from dwell.model.semantics import nearest_of

Phases: TypeAlias = "Literal['sync', 'even', 'random'] | tuple[float, ...]"
Coordination: TypeAlias = Literal["none", "random", "ledger"]
FleetObjective: TypeAlias = Literal["sum", "worst"]

#: What the phases of a fleet may be, beside a list of them.
PHASES = ("sync", "even", "random")
COORDINATIONS: tuple[str, ...] = get_args(Coordination)
OBJECTIVES: tuple[str, ...] = get_args(FleetObjective)
MOST_CELLS = 1_000
COUNT = Bound(1, MOST_CELLS, whole=True)


@declared()
class FleetEntry:
    """Cells of one kind."""

    cell: Problem
    count: int = key("How many cells of it there are.", COUNT, default=1)
    scenario: str = key("What befalls them.", default="baseline")
    policy: str | None = key("Their policy.", default=None, usual="the fleet's, or the cell's")
    estimator: str | None = key("Their estimator.", default=None, usual="the fleet's, or the cell's")
    phase_ms: float | None = key(
        "Offset of their releases, below P.", Bound(0), default=None, usual="as `phases` says"
    )

    def __post_init__(self) -> None:
        faults = []
        if self.scenario not in self.cell.scenarios:
            hint = nearest_of(self.scenario, self.cell.scenarios, "scenarios")
            faults.append(Fault("scenario", f"unknown scenario {self.scenario!r}; {hint}"))
        period_ms = self.cell.pipeline.period_ms
        if self.phase_ms is not None and self.phase_ms >= period_ms:
            bound = f"it must be less than period_ms, {period_ms:g}"
            faults.append(Fault("phase_ms", f"{self.phase_ms:g} is not allowed; {bound}"))
        if faults:
            raise ProblemError(faults)


@dataclass(frozen=True, slots=True)
class FleetCell:
    """One cell of a fleet.

    Parameters
    ----------
    name : str
        Its own, ``canonical-01``.
    copy : int
        Which of the cells of its file it is, from 1.
    entry : FleetEntry
    """

    name: str
    copy: int
    entry: FleetEntry

    @property
    def problem(self) -> Problem:
        """What it is."""
        return self.entry.cell

    @property
    def streams(self) -> str:
        """What the names of its random streams begin with: nothing for the first of its file."""
        return "" if self.copy == 1 else f"{self.problem.name}-{self.copy}/"


@dataclass(frozen=True, slots=True)
class Fleet:
    """Several cells that share nodes, each with a controller of its own.

    Parameters
    ----------
    name : str
    entries : tuple of FleetEntry
        In the order of the file.
    shared : tuple of str
        Nodes that are one computer for all cells.
    phases : {"sync", "even", "random"} or tuple of float
        Offsets of releases: all at once, evenly spread, drawn, or so many ms, by cell.
    coordination : {"none", "random", "ledger"}
        What moves are asked for.
    objective : {"sum", "worst"}
        What the ledger lowers.
    policy, estimator : str, optional
        Of every cell whose entry names none.

    Raises
    ------
    ProblemError
        If shared nodes are none of a cell's, or differ, or there are other phases than cells.
    """

    name: str
    entries: tuple[FleetEntry, ...]
    shared: tuple[str, ...] = ()
    phases: Phases = "random"
    coordination: Coordination = "ledger"
    objective: FleetObjective = "sum"
    policy: str | None = None
    estimator: str | None = None

    def __post_init__(self) -> None:
        faults = [*self._faults()]
        if faults:
            raise ProblemError(faults)

    def __repr__(self) -> str:
        kinds = ", ".join(f"{one.count} {one.cell.name}" for one in self.entries)
        return f"<Fleet {self.name}: {kinds}; shared: {', '.join(self.shared) or 'nothing'}>"

    @property
    def cells(self) -> tuple[FleetCell, ...]:
        """Every cell, in the order of the file; copies are counted over all entries of a file."""
        cells: list[FleetCell] = []
        copies = Counter[str]()
        for entry in self.entries:
            for _ in range(entry.count):
                copies[entry.cell.name] += 1
                copy = copies[entry.cell.name]
                cells.append(FleetCell(f"{entry.cell.name}-{copy:02}", copy, entry))
        return tuple(cells)

    def with_count(self, count: int) -> Fleet:
        """Return the fleet with so many cells of the first entry.

        Raises
        ------
        ProblemError
            If that is out of bounds, or phases are given one by one.
        """
        first, *others = self.entries
        return replace(self, entries=(replace(first, count=count), *others))

    def unused(self) -> tuple[str, ...]:
        """Return the shared nodes that no candidate of any cell uses."""
        used = {
            node
            for entry in self.entries
            for placement in entry.cell.candidates.values()
            for node in placement.values()
        }
        return tuple(name for name in self.shared if name not in used)

    def _faults(self) -> Iterator[Fault]:
        if not self.entries:
            yield Fault("cells", "the list is empty; name at least one cell")
            return
        count = sum(entry.count for entry in self.entries)
        if count > MOST_CELLS:
            yield Fault("cells", f"{count} cells are more than {MOST_CELLS}; give fewer")
        yield from self._apart()
        first = self.entries[0].cell
        for i, name in enumerate(self.shared):
            if name in self.shared[:i]:
                yield Fault(f"shared[{i}]", f"{name!r} is given twice; name each once")
                continue
            for place, entry in enumerate(self.entries):
                nodes = entry.cell.fabric.nodes
                if name not in nodes:
                    hint = nearest_of(name, nodes, "nodes")
                    yield Fault(f"shared[{i}]", f"{entry.cell.name} has no node {name!r}; {hint}")
                elif name in first.fabric.nodes:
                    here = f"cells[{place}].cell"
                    yield from _differences(here, nodes[name], first.fabric.nodes[name], first.name)
        if not isinstance(self.phases, str):
            yield from self._phase_faults(self.phases)

    def _apart(self) -> Iterator[Fault]:
        """Yield a fault for every entry that has another's name, and is another cell."""
        known: dict[str, Problem] = {}
        for place, entry in enumerate(self.entries):
            cell = known.setdefault(entry.cell.name, entry.cell)
            if cell != entry.cell:
                message = f"{entry.cell.name!r} is the name of another cell, too; give it its own"
                yield Fault(f"cells[{place}].cell", message)

    def _phase_faults(self, phases: tuple[float, ...]) -> Iterator[Fault]:
        cells = self.cells
        if len(phases) != len(cells):
            has = f"{len(phases)} phases for {len(cells)} cells"
            yield Fault("phases", f"{has}; give one for each, in the order of the file")
            return
        for i, (phase_ms, cell) in enumerate(zip(phases, cells, strict=True)):
            period_ms = cell.problem.pipeline.period_ms
            if not 0 <= phase_ms < period_ms:
                bound = f"it must be at least 0 and less than period_ms, {period_ms:g}"
                yield Fault(f"phases[{i}]", f"{phase_ms:g} is not allowed; {bound}")


def _differences(path: str, node: Node, other: Node, of: str) -> Iterator[Fault]:
    """Yield a fault for every key by which a shared node differs from that of the first cell."""
    named: Mapping[str, str] = {one.name: one.named for one in declared_fields(Node)}
    for one in fields(node):
        here, there = getattr(node, one.name), getattr(other, one.name)
        if here != there:
            what = f"{node.name}.{named.get(one.name, one.name)}"
            yield Fault(path, f"{what} is {here!r}, and {there!r} in {of}; a shared node is one")
