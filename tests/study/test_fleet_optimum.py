"""The plan against every placement of small random fleets, all by the ledger's own Φ."""

from __future__ import annotations

import pytest

from dwell.control.ledger import FleetLedger
from dwell.study.fleet_plan import plan_fleet
from tests.cells.random_fleets import every_phi, priced_cells, random_fleet


@pytest.mark.parametrize("seed", range(10))
def test_no_placements_are_better_than_the_plan_by_half_a_per_cent(seed: int) -> None:
    fleet = random_fleet(seed, most=5)
    phi = every_phi(FleetLedger(priced_cells(fleet), fleet.shared))
    planned = tuple(plan_fleet(fleet).placements.values())
    assert phi[planned] <= 1.005 * min(phi.values())
