"""What is read of a campaign's folder, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dwell.errors import RunError
from dwell_lab.testbed.campaign_folder import is_campaign, read_campaign


def test_runs_are_read_in_the_order_of_their_names_with_their_records(tmp_path: Path) -> None:
    (tmp_path / "campaign.json").write_text('{"plan": []}')
    for place in ("runs/0002-b", "runs/0001-a", "failed/0001-a.1"):
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / "attempt.json").write_text(json.dumps({"place": place}))
    # The folder of a run appears complete: one without a record is not there.
    (tmp_path / "runs" / "0003-c").mkdir()
    kept = read_campaign(tmp_path)
    assert kept.description == {"plan": []}
    assert [folder.name for folder in kept.done] == ["0001-a", "0002-b"]
    assert [record["place"] for record in kept.done.values()] == ["runs/0001-a", "runs/0002-b"]
    assert [record["place"] for record in kept.failed] == ["failed/0001-a.1"]


def test_what_is_no_campaign_is_refused(tmp_path: Path) -> None:
    assert not is_campaign(tmp_path)
    with pytest.raises(RunError, match="not a campaign"):
        read_campaign(tmp_path)
    file = tmp_path / "campaign.json"
    for text, message in (("{", "cannot be read"), ("[]", "describes no campaign")):
        file.write_text(text)
        with pytest.raises(RunError, match=message):
            read_campaign(tmp_path)
