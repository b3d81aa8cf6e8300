"""A plan of small random fleets, compared with all their placements."""

from __future__ import annotations

from benchmarks.figures import Figure, Goal, Section
from dwell.control.ledger import FleetLedger
from dwell.study.fleet_plan import plan_fleet
from tests.cells.random_fleets import every_phi, priced_cells, random_fleet


def measure(quick: bool) -> Section:
    """Return how far plans are above the least Φ of all placements."""
    above = []
    for seed in range(10 if quick else 40):
        fleet = random_fleet(seed, 5 if quick else 7)
        phi = every_phi(FleetLedger(priced_cells(fleet), fleet.shared))
        planned = tuple(plan_fleet(fleet).placements.values())
        above.append(100 * (phi[planned] / min(phi.values()) - 1))
    what = f"largest Φ above the least, {len(above)} fleets: plan"
    return Section("Placements of fleets", [Figure(what, [max(above)], "%", Goal(high=0.5))])
