"""Minutes of chaos: real processes, many kinds of faults, judged from the wire."""

from __future__ import annotations

import os
from itertools import islice
from pathlib import Path

import pytest

from dwell.cellfile import from_document
from dwell_lab.chaos.fault_campaign import FaultCampaign, Staging
from dwell_lab.chaos.faults import faults_of, planned
from dwell_lab.chaos.light_cell import PATIENT_MS, document
from lab.tests.testbed.machine import no_groups, no_hosts

pytestmark = pytest.mark.skipif(
    len(os.sched_getaffinity(0)) < 2,
    reason="twenty processes that must keep to a period of 80 ms need two CPUs",
)
#: The seed, the number of faults, and how many of them happen in any case: about 6 s per fault on
#: two CPUs that are idle, longer on busy ones. No two faults of both places are of the same kind;
#: other tests on real processes kill, freeze and slow them and set their clocks.
PLACES = {"loopback": (15203, 4, 3), "hosts": (824, 4, 3)}
SECONDS = 90.0


@pytest.mark.parametrize("place", PLACES)
def test_the_cell_keeps_its_promises(
    place: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if place == "hosts" and (why := no_hosts() or no_groups()):
        pytest.skip(why)
    seed, faults, fewest = PLACES[place]
    staging = Staging(None, tmp_path, seed, hosts=place == "hosts")
    command = "dwell testbed chaos" + (" --hosts" if place == "hosts" else "")
    campaign = FaultCampaign(staging, f"{command} --seed {seed}", print)
    result = campaign.run(seconds=SECONDS, faults=faults)
    assert not result.wrong, "\n".join([*result.wrong, capsys.readouterr().out])
    assert len(result.outcomes) >= fewest
    # Who hears nothing finds nothing wrong.
    assert result.heard["stamped"] > 0.5 * result.actuated > 50
    assert {"accepted", "done", "in", "order"} <= result.heard.keys()
    assert [one.number for one, _ in islice(result.outcomes, 3)] == [1, 2, 3]


def test_every_fault_is_of_another_kind() -> None:
    problem = from_document(document("SO", period_ms=PATIENT_MS))
    kinds = [
        one.fault.kind
        for seed, faults, _ in PLACES.values()
        for one in islice(planned(seed, list(faults_of(problem, disks=True))), faults)
    ]
    assert len(kinds) == len(set(kinds)) == 8


def test_a_campaign_without_a_fault_has_failed(tmp_path: Path) -> None:
    campaign = FaultCampaign(Staging(None, tmp_path, 1), "dwell testbed chaos", print)
    result = campaign.run(faults=0)
    assert result.wrong == ["no fault has befallen the cell: nothing was watched"]
