from __future__ import annotations

import pytest

from dwell.errors import ProblemError
from dwell.model import Endpoint, Host, LiveSettings
from dwell.model.live import require_callable_name


def test_a_host_is_seen_at_its_own_address_unless_from_elsewhere() -> None:
    host = Host("10.0.0.2", 7450, {"R1": Endpoint("192.168.1.9", 9000)})
    assert host.endpoint("R1") == Endpoint("192.168.1.9", 9000)
    assert host.endpoint("R2") == Endpoint("10.0.0.2", 7450)


@pytest.mark.parametrize(("address", "port"), [("", 7450), ("  ", 7450), ("h", 0), ("h", 70_000)])
def test_what_is_no_endpoint(address: str, port: int) -> None:
    with pytest.raises(ProblemError):
        Host(address, port)


@pytest.mark.parametrize("field", ["release", "clock", "mode", "silence"])
def test_a_setting_is_one_of_its_words(field: str) -> None:
    with pytest.raises(ProblemError, match=rf"live\.{field}.*one of "):
        LiveSettings(**{field: "sometimes"})  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["stages", "stages:", ":Plan", "my stages:Plan", "a.b:c d"])
def test_a_class_is_named_by_module_and_name(name: str) -> None:
    require_callable_name("run", "my.stages:Plan.inner")
    with pytest.raises(ProblemError, match=r"package\.module:Name"):
        require_callable_name("run", name)
    with pytest.raises(ProblemError, match=r"live\.actuators\.control"):
        LiveSettings(actuators={"control": name})


def test_a_cell_above_the_aim_is_degraded() -> None:
    assert LiveSettings().degraded_by([0.06, 0.06, 0.06])
    assert not LiveSettings().degraded_by([0.05, 0.05, 0.05])
    assert not LiveSettings(degraded_at=0.1).degraded_by([0.06, 0.06, 0.06])
