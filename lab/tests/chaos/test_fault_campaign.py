"""Minutes of chaos: real processes, many kinds of faults, judged from the wire."""

from __future__ import annotations

import os
from itertools import islice
from pathlib import Path

import pytest

from dwell_lab.chaos.fault_campaign import FaultCampaign, Staging
from lab.tests.testbed.machine import no_groups, no_hosts

pytestmark = pytest.mark.skipif(
    len(os.sched_getaffinity(0)) < 2,
    reason="twenty processes that must keep to a period of 80 ms need two CPUs",
)
SEED = 1
#: Faults on one machine (each of another kind) and on hosts of their own, and how many there are
#: in any case: two minutes of each on two CPUs that are idle, longer on busy ones.
PLACES = {"loopback": (13, 6), "hosts": (8, 4)}
SECONDS = 200.0


@pytest.mark.parametrize("place", PLACES)
def test_the_cell_keeps_its_promises(
    place: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if place == "hosts" and (why := no_hosts() or no_groups()):
        pytest.skip(why)
    faults, fewest = PLACES[place]
    staging = Staging(None, tmp_path, SEED, hosts=place == "hosts")
    command = "dwell testbed chaos" + (" --hosts" if place == "hosts" else "")
    campaign = FaultCampaign(staging, f"{command} --seed {SEED}", print)
    result = campaign.run(seconds=SECONDS, faults=faults)
    assert not result.wrong, "\n".join([*result.wrong, capsys.readouterr().out])
    assert len(result.outcomes) >= fewest
    # Who hears nothing finds nothing wrong.
    assert result.heard["stamped"] > 0.5 * result.actuated > 100
    assert {"accepted", "done", "in", "order"} <= result.heard.keys()
    assert [one.number for one, _ in islice(result.outcomes, 3)] == [1, 2, 3]


def test_a_campaign_without_a_fault_has_failed(tmp_path: Path) -> None:
    campaign = FaultCampaign(Staging(None, tmp_path, SEED), "dwell testbed chaos", print)
    result = campaign.run(faults=0)
    assert result.wrong == ["no fault has befallen the cell: nothing was watched"]
