"""A campaign's folder: a Run folder for every completed run, and the remains of failed attempts.

It contains ``campaign.json`` (the campaign's description), ``traces`` (files that its cell
replays), ``runs`` and ``failed``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from dwell.cellfile.work_folder import FolderMark
from dwell.errors import RunError
from dwell.record.json_documents import read_document

RUNS, FAILED, TRACES = "runs", "failed", "traces"
#: Stored with the tables of a run: its time, and the state of the machine.
ATTEMPT = "attempt.json"
CAMPAIGN = FolderMark("campaign", "campaign.json", 1, (RUNS, FAILED, TRACES))


class CampaignFolder(NamedTuple):
    """Content of a campaign's folder.

    `description` is the result of `Campaign.describe`, `done` maps the folder of every completed
    run, in the order of the plan, to its record, and `failed` has the records of failed attempts.
    """

    description: Mapping[str, Any]
    done: Mapping[Path, Mapping[str, Any]]
    failed: tuple[Mapping[str, Any], ...]


def is_campaign(folder: Path) -> bool:
    """Whether a folder is a campaign's."""
    return (folder / CAMPAIGN.file).is_file()


def read_campaign(folder: Path) -> CampaignFolder:
    """Read a campaign's folder; the campaign may still be running.

    Raises `RunError` if the folder is not a campaign or cannot be read.
    """
    if not is_campaign(folder):
        raise RunError(f"{folder}: not a campaign (it has no {CAMPAIGN.file})")
    described = read_document(folder / CAMPAIGN.file)
    if "plan" not in described:
        raise RunError(f"{folder / CAMPAIGN.file} describes no campaign")
    done = {
        file.parent: read_document(file) for file in sorted((folder / RUNS).glob(f"*/{ATTEMPT}"))
    }
    failed = tuple(read_document(file) for file in sorted((folder / FAILED).glob(f"*/{ATTEMPT}")))
    return CampaignFolder(described, done, failed)
