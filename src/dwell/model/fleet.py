"""Fleet: several cells that share nodes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, TypeAlias

from dwell.errors import Fault, ProblemError
from dwell.model.bounds import Bound, as_read, counted
from dwell.model.declaration import declared, declared_fields, key
from dwell.model.fabric import Node
from dwell.model.objective import AIM
from dwell.model.problem import Problem
from dwell.model.scenario import Disturbance, NodeDisturbance, Scenario
from dwell.model.semantics import episode_faults, nearest, nearest_of

Phases: TypeAlias = "Literal['sync', 'even', 'random'] | tuple[float, ...]"
Coordination: TypeAlias = Literal["none", "random", "ledger"]
FleetObjective: TypeAlias = Literal["sum", "worst", "served"]

#: Words for the phases of a fleet; a list of phases is also allowed.
PHASES = ("sync", "even", "random")
PHASE_WAYS = f"one of {', '.join(PHASES)}, or a list of ms"
MOST_CELLS = 1_000
COUNT = Bound(1, MOST_CELLS, whole=True)

#: Count and cell of an entry; None for an unreadable cell.
Kind: TypeAlias = "tuple[int, Problem | None]"


@declared()
class FleetEntry:
    """Cells of one kind."""

    cell: Problem
    count: int = key("How many cells of it there are.", COUNT, default=1)
    scenario: str = key("Scenario of these cells.", default="baseline")
    policy: str | None = key("Their policy.", default=None, usual="the fleet's, or the cell's")
    estimator: str | None = key(
        "Their estimator.", default=None, usual="the fleet's, or the cell's"
    )
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
        As ``canonical-01``.
    copy : int
        Its number among the cells of the same file, from 1.
    entry : FleetEntry
    """

    name: str
    copy: int
    entry: FleetEntry

    @property
    def problem(self) -> Problem:
        """The cell's problem."""
        return self.entry.cell

    @property
    def streams(self) -> str:
        """Prefix of the names of its random streams; empty for the first cell of its file."""
        return "" if self.copy == 1 else f"{self.problem.name}-{self.copy}/"


@declared()
class Fleet:
    """Several cells that share nodes, each with its own controller."""

    name: str
    entries: tuple[FleetEntry, ...]
    shared: tuple[str, ...] = key("Nodes that are one computer for all cells.", default=())
    phases: Phases = key(
        "Start of each cell: all at once, evenly spread, random, or by a list.", default="random"
    )
    coordination: Coordination = key(
        "Approval of a move: none needed, by chance, or by the ledger.", default="ledger"
    )
    objective: FleetObjective = key(
        "Aim of the ledger and of plans: the least sum of costs, the least cost of the worst "
        "cell, or the most cells whose V_D is at most `limit`.",
        default="sum",
    )
    limit: float | None = key(
        "Largest V_D of a cell that is served.",
        Bound(0, 1, above=True, below=True),
        default=None,
        usual=f"{AIM} with `objective: served`",
    )
    policy: str | None = key("Policy of cells that name none.", default=None, usual="the cell's")
    estimator: str | None = key(
        "Estimator of cells that name none.", default=None, usual="the cell's"
    )
    #: The file of the fleet; empty if it was not read from a file.
    file: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        if not isinstance(self.phases, str):
            object.__setattr__(self, "phases", tuple(self.phases))
        if self.objective == "served" and self.limit is None:
            object.__setattr__(self, "limit", AIM)
        kinds = [(entry.count, entry.cell) for entry in self.entries]
        faults = [*fleet_faults(kinds, self.shared, self.phases)]
        met = [
            (f"cells[{i}].scenario", item)
            for i, entry in enumerate(self.entries)
            for item in self._of(entry)
        ]
        faults += episode_faults(met)
        if faults:
            raise ProblemError(faults)

    @property
    def aim(self) -> float:
        """Share of missed deadlines that each cell should be under: `limit`, if it is set."""
        return AIM if self.limit is None else self.limit

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

    @property
    def problems(self) -> dict[str, Problem]:
        """The problem of every cell, by the cell's name."""
        return {cell.name: cell.problem for cell in self.cells}

    def policy_of(self, entry: FleetEntry) -> str:
        """Return the policy of the cells of an entry."""
        return entry.policy or self.policy or entry.cell.controller.policy

    def candidate_of(self, entry: FleetEntry) -> str | None:
        """Return the candidate that the cells of an entry never leave; None if they may move."""
        name, _ = entry.cell.policy_and_estimator(self.policy_of(entry))
        return name if name in entry.cell.candidates else None

    @property
    def is_static(self) -> bool:
        """Whether no cell moves."""
        return all(self.candidate_of(entry) is not None for entry in self.entries)

    @property
    def disturbances(self) -> Scenario:
        """Disturbances of shared nodes by the scenarios of its cells, without duplicates."""
        return tuple(dict.fromkeys(item for entry in self.entries for item in self._of(entry)))

    def _of(self, entry: FleetEntry) -> Iterator[Disturbance]:
        for item in entry.cell.scenario(entry.scenario):
            if isinstance(item, NodeDisturbance) and item.node in self.shared:
                yield item

    def duration_ns(self, windows: int) -> int:
        """Return the length of this many of the longest windows."""
        return windows * max(entry.cell.window_ns for entry in self.entries)

    @property
    def warmup_ns(self) -> int:
        """Longest warm-up of a cell; statistics of all cells begin after it."""
        cells = [entry.cell for entry in self.entries]
        return max(cell.warmup_windows * cell.window_ns for cell in cells)

    @property
    def phasing(self) -> str:
        """The word for the phases of the cells; ``listed`` for a list of phases."""
        return self.phases if isinstance(self.phases, str) else "listed"

    def changed(
        self,
        *,
        policy: str | None = None,
        estimator: str | None = None,
        coordination: str | None = None,
        phases: str | Sequence[float] | None = None,
    ) -> Fleet:
        """Return the fleet, and its entries, with other settings; None keeps a setting.

        Raises a ProblemError if a value is unknown.
        """
        given = {
            "policy": policy,
            "estimator": estimator,
            "coordination": coordination,
            "phases": phases,
        }
        new: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        own: Any = {name: None for name in ("policy", "estimator") if name in new}
        return replace(self, entries=tuple(replace(one, **own) for one in self.entries), **new)

    def with_count(self, count: int) -> Fleet:
        """Return the fleet with another number of cells of the first entry.

        Raises a ProblemError if the number is out of bounds, or does not match a list of phases.
        """
        first, *others = self.entries
        return replace(self, entries=(replace(first, count=count), *others))

    def without_effect(self) -> Iterator[Fault]:
        """Yield the settings that change nothing."""
        for name in self.unused():
            yield Fault(f"shared.{name}", "no candidate of any cell uses this node")
        if self.limit is not None and self.objective != "served":
            remedy = "remove it, or set `objective: served`"
            yield Fault("limit", f"it has no effect with objective {self.objective}; {remedy}")

    def unused(self) -> tuple[str, ...]:
        """Return the shared nodes that no candidate of any cell uses."""
        used = {
            node
            for entry in self.entries
            for placement in entry.cell.candidates.values()
            for node in placement.values()
        }
        return tuple(name for name in self.shared if name not in used)


def fleet_faults(kinds: Sequence[Kind], shared: Sequence[str], phases: Phases) -> Iterator[Fault]:
    """Yield the faults of a fleet that concern more than one entry."""
    if not kinds:
        yield Fault("cells", "the list is empty; name at least one cell")
    count = sum(of for of, _ in kinds)
    if count > MOST_CELLS:
        yield Fault("cells", f"{count} cells are more than {MOST_CELLS}; give fewer")
    known: dict[str, tuple[int, Problem]] = {}
    for place, (_, cell) in enumerate(kinds):
        if cell is not None and known.setdefault(cell.name, (place, cell))[1] != cell:
            message = f"{cell.name!r} is the name of another cell, too; give it its own"
            yield Fault(f"cells[{place}].cell", message)
    for place, (_, cell) in enumerate(kinds):
        if cell is not None and cell.is_searched:
            message = f"{cell.name} has `candidates: all`, which fleets do not support"
            remedy = "paste the block of `dwell candidates CELL --yaml`"
            yield Fault(f"cells[{place}].cell", f"{message}; {remedy}")
    for i, name in enumerate(shared):
        if name in shared[:i]:
            yield Fault(f"shared[{i}]", f"{name!r} is given twice; name each once")
        else:
            yield from _node_faults(f"shared[{i}]", name, [*known.values()])
    if isinstance(phases, str):
        if phases not in PHASES:
            hint = nearest(phases, PHASES)
            remedy = f"; {hint}" if hint.startswith("did") else ""
            yield Fault(
                "phases", f"{as_read(phases)} is not allowed; it must be {PHASE_WAYS}{remedy}"
            )
    elif kinds:
        yield from _phase_faults(kinds, phases)


def _node_faults(path: str, name: str, cells: Sequence[tuple[int, Problem]]) -> Iterator[Fault]:
    """Yield a fault for each cell that lacks a shared node or has a different node."""
    first: Problem | None = None
    for place, cell in cells:
        nodes = cell.fabric.nodes
        if name not in nodes:
            hint = nearest_of(name, nodes, "nodes")
            yield Fault(path, f"{cell.name} has no node {name!r}; {hint}")
            continue
        first = first or cell
        of = first.fabric.nodes[name]
        yield from _differences(f"cells[{place}].cell", nodes[name], of, first.name)


def _phase_faults(kinds: Sequence[Kind], phases: Sequence[float]) -> Iterator[Fault]:
    cells = [cell for count, cell in kinds for _ in range(count)]
    if len(phases) != len(cells):
        has = f"{counted(len(phases), 'phase')} for {counted(len(cells), 'cell')}"
        yield Fault("phases", f"{has}; give one for each, in the order of the file")
        return
    for i, (phase_ms, cell) in enumerate(zip(phases, cells, strict=True)):
        if cell is not None and not 0 <= phase_ms < cell.pipeline.period_ms:
            bound = f"it must be at least 0 and less than period_ms, {cell.pipeline.period_ms:g}"
            yield Fault(f"phases[{i}]", f"{phase_ms:g} is not allowed; {bound}")


def _differences(path: str, node: Node, other: Node, of: str) -> Iterator[Fault]:
    """Yield a fault for every key of a shared node that differs from the first cell's node."""
    named: Mapping[str, str] = {one.name: one.named for one in declared_fields(Node)}
    for one in fields(node):
        here, there = getattr(node, one.name), getattr(other, one.name)
        if here != there:
            what = f"{node.name}.{named.get(one.name, one.name)}"
            yield Fault(path, f"{what} is {here!r}, and {there!r} in {of}; a shared node is one")
