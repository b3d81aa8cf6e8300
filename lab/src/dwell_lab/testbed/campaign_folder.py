"""A campaign's folder: a Run folder for every run that is done, and what attempts left that failed.

It holds ``campaign.json`` (what campaign it is), ``traces`` (files that its cell replays), ``runs``
and ``failed``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from dwell.cellfile.work_folder import FolderMark
from dwell.errors import RunError
from dwell.record.json_documents import read_document

RUNS, FAILED, TRACES = "runs", "failed", "traces"
#: Beside the tables of a run: when it was made, and how the machine was.
ATTEMPT = "attempt.json"
CAMPAIGN = FolderMark("campaign", "campaign.json", 1, (RUNS, FAILED, TRACES))


class CampaignFolder(NamedTuple):
    """Content of a campaign's folder.

    Parameters
    ----------
    description : mapping
        See `dwell_lab.testbed.campaign.Campaign.describe`.
    done : mapping of Path to mapping
        Folder of every run that is done, in the order of the plan, with its record.
    failed : tuple of mapping
        Records of the attempts that failed.
    """

    description: Mapping[str, Any]
    done: Mapping[Path, Mapping[str, Any]]
    failed: tuple[Mapping[str, Any], ...]


def is_campaign(folder: Path) -> bool:
    """Whether a folder is a campaign's."""
    return (folder / CAMPAIGN.file).is_file()


def read_campaign(folder: Path) -> CampaignFolder:
    """Read a campaign's folder, also while the campaign goes on.

    Raises
    ------
    RunError
        If it holds none, or what it holds cannot be read.
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
