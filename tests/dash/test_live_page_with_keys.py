"""The page of a live cell with keys: who may look at it, and who may act."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cli.live_cell import RealCell, invoke
from tests.dash.served import serving, until_state
from tests.live.commands.test_live_secure import SecureCell
from tests.waiting import wait_until


@pytest.fixture(scope="module")
def secure(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecureCell]:
    made = SecureCell(tmp_path_factory.mktemp("secure"))
    try:
        made.begin()
        yield made
    finally:
        made.close()


def test_an_observer_sees_and_may_not_act(secure: SecureCell) -> None:
    keys = secure.host / "watcher"
    code, stdout, stderr = invoke(
        *("dash", secure.file, "--control", "--keys", keys, "--port", "0", "--no-browser")
    )
    assert (code, stdout) == (2, "")
    assert "observer" in stderr
    with serving(secure.folder, secure.file, "--keys", keys) as page:
        until_state(page, lambda found: found["health"] == "ok")
        wait_until(lambda: page.get("/view?begin=0&end=1e6")["cycles"] > 20)
        assert page.act("pin", {"candidate": "SO"}).status == 403


def test_an_operator_acts_by_name(secure: SecureCell) -> None:
    with serving(
        secure.folder, secure.file, "--control", "--keys", secure.host / "operator"
    ) as page:
        assert page.get("/cells")["cells"][0]["certificate"].startswith("operator.")
        assert page.act("pin", {"candidate": "SO"}).status == 200
        until_state(page, lambda found: found["placement"] == "SO")
        assert page.act("unpin", {}).status == 200
        assert "pin SO by operator." in page.said


def test_without_keys_it_acts_on_this_computer_alone(tmp_path: Path) -> None:
    made = RealCell(tmp_path)
    text = made.file.read_text()
    assert "address: 127.0.0.1" in text
    made.file.write_text(text.replace("address: 127.0.0.1", "address: 10.255.0.9", 1))
    words = ("dash", made.file, "--port", "0", "--no-browser")
    for more in ((), ("--insecure", "--control")):
        code, stdout, stderr = invoke(*words, *more)
        assert code in {1, 2}
        assert stdout == ""
        assert "beyond this computer" in stderr
