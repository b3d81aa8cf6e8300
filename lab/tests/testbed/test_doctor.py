"""The doctor: finds what there is, refuses what does not fit, and leaves nothing behind."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import pytest

import dwell
from dwell.cli.findings import Check, Finding
from dwell.errors import LiveError
from dwell.live.local.cgroups import find_cgroups
from dwell.model import Problem, Quota
from dwell_lab.testbed import doctor
from dwell_lab.testbed.doctor import checks_for, examine
from dwell_lab.testbed.probe import Lateness
from lab.tests.testbed.machine import no_groups, no_hosts
from tests.cells.once import with_windows

ROOT = Path(__file__).parents[3]
NEEDED = {
    "root",
    "ip",
    "nsenter",
    "network namespaces",
    "TUN devices",
    "CPU quotas",
    "shortest period of a quota",
    "CPUs of a group",
    "CPUs",
}


def system() -> list[str]:
    """Namespaces, groups and devices that there are now."""
    folders = [Path("/run/netns"), Path("/run/dwell")]
    if not no_groups():
        folders += find_cgroups().groups()
    files = [str(file) for folder in folders if folder.is_dir() for file in folder.iterdir()]
    links = os.listdir("/sys/class/net")
    return sorted(file for file in (*files, *links) if "doctor" in file or "/" not in file)


def with_quotas(*quotas: Quota) -> Problem:
    """The demo's cell; of its nodes the first have these quotas."""
    problem = dwell.load(ROOT / "examples" / "visual_servoing" / "cell.yaml")
    nodes = dict(problem.fabric.nodes)
    for name, quota in zip(list(nodes), quotas, strict=False):
        nodes[name] = replace(nodes[name], cores=1, quota=quota)
    return replace(problem, fabric=replace(problem.fabric, nodes=nodes))


def finding_of(name: str, problems: list[Problem], watch_s: float = 0.0) -> Finding:
    """Run a single check."""
    checks = checks_for(problems, watch_s=watch_s)
    return next(one for one in checks if one.name == name).finding()


@pytest.mark.skipif(bool(no_hosts() or no_groups()), reason=no_hosts() or no_groups())
def test_a_machine_that_runs_testbeds_is_well_and_stays_as_it_is() -> None:
    before = system()
    findings = examine()
    assert {one.name for one in findings if one.needed} == NEEDED
    bad = [one for one in findings if one.needed and not one.ok and one.name != "CPUs"]
    assert bad == []
    assert system() == before


def test_all_findings_say_what_was_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without any command of the system: each that is missing is named with its remedy."""
    monkeypatch.setenv("PATH", "/nowhere")
    findings = {one.name: one for one in examine()}
    assert all(one.found for one in findings.values())
    assert findings["ip"].remedy == "apt-get install iproute2"
    assert findings["stress-ng"].remedy == "apt-get install stress-ng"
    assert not findings["stress-ng"].needed
    assert not findings["ip"].ok
    assert not any(one.remedy for one in findings.values() if one.ok)


def test_quotas_that_fit_are_told_where_they_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    finding = finding_of("CPUs", [with_quotas(Quota(0.4, 4), Quota(0.4, 4), Quota(0.8, 4))])
    assert finding.ok
    assert " on 1" in finding.found


@pytest.mark.parametrize(
    ("quotas", "said"),
    [
        ((Quota(0.4, 4), Quota(0.9, 4), Quota(0.3, 4)), "of the 0.8 per CPU that nodes may use"),
        ((Quota(0.5, 4), Quota(0.5, 4), Quota(0.7, 4)), "1.6"),
        ((Quota(0.1, 4), Quota(0.4, 4), Quota(0.8, 4)), "at least 1 ms"),
    ],
)
def test_quotas_that_do_not_fit_are_refused(
    monkeypatch: pytest.MonkeyPatch, quotas: tuple[Quota, ...], said: str
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    finding = finding_of("CPUs", [with_quotas(*quotas)])
    assert not finding.ok
    assert finding.needed
    assert said in finding.found
    assert finding.remedy


def test_a_machine_with_one_cpu_has_little_to_give(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    assert "0.6 for nodes" in finding_of("CPUs", []).found


def test_what_goes_wrong_in_a_check_is_a_finding() -> None:
    def fail() -> tuple[bool, str]:
        raise LiveError("it is not there")

    assert Check("it", fail, "get it").finding() == Finding(
        "it", False, "it is not there", "get it"
    )


class Standing:
    """A probe that is late at every third look."""

    def __init__(self, cpu: int) -> None:
        self.looks = 0

    def __enter__(self) -> Standing:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def read(self) -> Lateness:
        self.looks += 1
        late_ms = 30.0 if self.looks % 3 == 0 else 0.1
        return Lateness(max_ms=late_ms, work_ms=None)


def test_a_machine_that_stands_still_at_times_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "Probe", Standing)
    finding = finding_of("no standstills", [], 2.5)
    assert not finding.ok
    assert not finding.needed
    assert "longest was 30.0 ms" in finding.found
    assert "100% of the windows of 2 s" in finding.found
    assert finding.remedy
    # Windows that are so short that most of them had none, but not enough.
    short = with_windows(with_quotas(), 1)
    finding = finding_of("no standstills", [short], 2.5)
    share = int(re.findall(r"(\d+)% of the windows", finding.found)[0])
    assert 5 < share < 60
    assert not finding.ok


def test_a_watch_is_only_kept_where_it_is_asked_for() -> None:
    finding = next(one for one in examine(watch_s=0.5) if one.name == "no standstills")
    assert "in 0.5 s the longest was" in finding.found
    assert "no standstills" not in {one.name for one in examine()}
