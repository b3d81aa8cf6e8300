"""Plan and ledger of small random fleets, compared with all placements."""

from __future__ import annotations

from typing import NamedTuple

from benchmarks.figures import Figure, Goal, Section
from dwell.control.ledger import FleetLedger
from dwell.study.fleet_plan import plan_fleet
from tests.cells.random_fleets import every_phi, priced_cells, random_fleet, reordered, settle


class _Ends(NamedTuple):
    """How far plan and ledger are above the least Φ, per cent; and whether the ledger is near."""

    plan: float
    ledger: float
    is_near: bool


def measure(quick: bool) -> Section:
    """Return how far plans are above the least Φ, and how many ledgers end near it.

    A row is printed for each fleet, in the order of its file and the other way round.
    """
    count, most = (10, 5) if quick else (40, 7)
    found = []
    for seed in range(count):
        for turned in (False, True):
            ends = _ends(seed, most, turned=turned)
            row = f"fleet {seed:2}{' turned' * turned:7}: plan {ends.plan:+5.2f} %"
            far = "" if ends.is_near else ", not near"
            print(f"{row}, ledger {ends.ledger:+6.2f} %{far}", flush=True)
            found.append(ends)
    near = 100 * sum(ends.is_near for ends in found) / len(found)
    figures = [
        Figure("largest Φ of a plan above the least", [max(ends.plan for ends in found)], "%",
               Goal(high=0.5)),
        Figure("ledgers that end near the least Φ", [near], "%", Goal(low=100)),
    ]  # fmt: skip
    return Section(f"Placements of {len(found)} fleets", figures)


def _ends(seed: int, most: int, *, turned: bool) -> _Ends:
    fleet = random_fleet(seed, most)
    order = range(len(fleet.cells))
    # The names, and with them the draws, follow the order of the file.
    asked = reordered(fleet, order[::-1] if turned else order)
    ledger = FleetLedger(priced_cells(asked), asked.shared)
    settle(ledger, order)
    phi = every_phi(ledger)
    best = min(phi, key=phi.__getitem__)
    owed = sum(ledger.owed(i, name) for i, name in enumerate(best))
    end, planned = tuple(ledger.placements), tuple(plan_fleet(asked).placements.values())
    plan, above = (100 * (phi[one] / phi[best] - 1) for one in (planned, end))
    return _Ends(plan, above, phi[end] <= max(1.01 * phi[best], phi[best] + owed))
