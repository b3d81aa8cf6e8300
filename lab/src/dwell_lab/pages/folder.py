"""Pages of campaigns and validations for `dwell report` and notebooks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, cast

from dwell.report.added import FolderPages, ResultPages
from dwell.report.page import Page
from dwell_lab.testbed.campaign_folder import is_campaign

if TYPE_CHECKING:
    from dwell_lab.validation.validation import Validation


def _write(folder: Path, page: Path, *, figures: Path | None, static: bool, as_json: bool) -> None:
    from dwell_lab.commands.campaign import report_campaign

    report_campaign(folder, page, figures=figures, static=static, as_json=as_json)


def _page(shown: object, sections: int | None) -> Page:
    from dwell_lab.pages.validation_page import validation_page

    return validation_page(cast("Validation", shown), sections=sections)


CAMPAIGN = FolderPages(is_campaign, _write)
VALIDATION = ResultPages("Validation", _page)
