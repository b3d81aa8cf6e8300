"""What tests of the page share: a run, and a page of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from tests.dash.browser import chromium
from tests.dash.recorded import small_fleet, small_run
from tests.dash.served import Served, serving


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run that kept its jobs."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    small_run(folder)
    return folder


@pytest.fixture(scope="module")
def fleet_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a fleet's runs that kept their jobs."""
    folder = tmp_path_factory.mktemp("fleets") / "pack"
    small_fleet(folder)
    return folder


@pytest.fixture(scope="module")
def page(run_folder: Path) -> Iterator[Served]:
    """Return a page of that run."""
    with serving(run_folder.parent, run_folder) as served:
        yield served


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Return a browser without a page."""
    with chromium() as made:
        yield made
