"""Real hosts: a cell on the computers of an inventory, run as on a testbed.

All files on a host are in one folder with the testbed's name, which is removed before the next run.
Links are real; the inventory's commands disturb them. The pressure on the hosts is unknown, so no
window is excluded.
"""

from __future__ import annotations

import io
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from dwell.errors import LiveError
from dwell.estimators.registry import resolved
from dwell.live.host.hosting import clock_of
from dwell.live.host.node_processes import end_all
from dwell.live.host.operator_client import OperatorClient
from dwell.live.local.conditions import Conditions
from dwell.live.local.playing import Played, make_folder, play_on, require_run, undisturbed
from dwell.live.local.processes import Processes
from dwell.live.local.testbed import MARK, STARTING, Testbed
from dwell.live.local.timeline import NodeState, timeline_of, usual_conditions
from dwell.model import Host, Link, LinkDisturbance, Normal, Problem
from dwell.model.scenario import Disturbance
from dwell.policies.registry import by_name, estimator_of
from dwell.record import open_run
from dwell_lab.testbed.inventory import Inventory
from dwell_lab.testbed.remote import SHELL_ID, RemoteProcess, script_of

NAME = re.compile(r"[A-Za-z0-9_-]{1,32}")
#: Timeout of a command that ends by itself, seconds.
COMMAND_S = 60.0
STOP_S = 10.0
#: Bound below which a loss is a rounding error.
LEAST_LOSS = 1e-9


class RealHosts(Testbed):
    """Context manager that runs a cell on real hosts.

    Parameters
    ----------
    problem : Problem
        The cell; the attribute `problem` becomes a copy with the addresses of the hosts.
    folder : Path
        Folder on this computer for the cell file and logs.
    name : str
        Name of this testbed, unique on those hosts.
    more : sequence of str
        Further arguments of the controller.

    Raises
    ------
    LiveError
        If the name is invalid.
    """

    def __init__(
        self,
        problem: Problem,
        inventory: Inventory,
        folder: Path,
        *,
        name: str,
        more: Sequence[str] = (),
    ) -> None:
        if not NAME.fullmatch(name):
            raise LiveError(f"name is {name!r}; it must be letters, digits, - and _, at most 32")
        super().__init__()
        hosts = {node: Host(host.address, host.port) for node, host in inventory.hosts.items()}
        self.problem = replace(problem, live=replace(problem.live, hosts=hosts))
        self.inventory, self.folder, self.name = inventory, folder.resolve(), name
        self.stress: dict[str, RemoteProcess] = {}
        self._threads: dict[str, int] = {}
        self._disturbed: set[str] = set()
        self.processes = Processes(
            self.problem,
            self.folder,
            inside=self.inside,
            more=more,
            popen=RemoteProcess,
            owner=SHELL_ID,
        )

    def _start(self) -> None:
        """Copy the cell file to all hosts, start all processes, and begin a run."""
        self.processes.write()
        self._stack.callback(self._undisturb)
        self._stack.callback(self.processes.stop)
        for node in self.problem.fabric.nodes:
            self._prepare(node)
        for node in self.problem.fabric.nodes:
            self.processes.start_agent(node)
        self._client = self._stack.enter_context(OperatorClient(self.problem))
        self._come_up()
        self.begin()
        # The stamper's clock differs: use this computer's, read when `begin` returns.
        self.begun_ns = clock_of(self.problem)()

    def stop(self) -> None:
        """End processes and disturbances; the hosts keep the runs until the next start."""
        with undisturbed():
            super().stop()

    def sample(self, patience_s: float) -> Mapping[str, Any]:
        """Return the status of the cell, from its controller."""
        return self._client.ask("status", patience_s=patience_s)

    # ------------------------------------------------------------------------ commands

    def there(self, node: str) -> str:
        """Folder of this testbed on a node's host."""
        return f"{self.inventory.hosts[node].folder}/dwell-{self.name}-{node}"

    def inside(self, node: str, words: Sequence[str]) -> Sequence[str]:
        """Return a command for `RemoteProcess` that runs words on a node's host.

        In the words, the host's interpreter and folder replace this computer's.
        """
        return self._words(node, [self._translated(node, word) for word in words])

    def _words(self, node: str, words: Sequence[str], *, whole: bool = False) -> list[str]:
        host = self.inventory.hosts[node]
        environment = {
            name: value for name, value in os.environ.items() if name.startswith("DWELL_")
        }
        if "--cpus" not in words and host.cpus and "dwell" in words:
            words = [*words, "--cpus", host.cpus]
        return [*host.run, script_of(words, self.there(node), environment, whole=whole)]

    def _translated(self, node: str, word: str) -> str:
        if word == sys.executable:
            return self.inventory.hosts[node].python
        here = str(self.folder)
        if word == here or word.startswith(f"{here}/"):
            return self.there(node) + word.removeprefix(here)
        return word

    def shell(self, node: str, line: str, data: bytes = b"") -> bytes:
        """Run a line in a shell on a node's host; return its output.

        Raises
        ------
        LiveError
            If the line fails, or exceeds `COMMAND_S`.
        """
        command = [*self.inventory.hosts[node].run, line]
        try:
            done = subprocess.run(  # noqa: S603 - the inventory's
                command, input=data, capture_output=True, timeout=COMMAND_S, check=False
            )
        except OSError as error:
            raise LiveError(f"{node}: {command[0]} cannot be run ({error.strerror})") from None
        except subprocess.TimeoutExpired:
            raise LiveError(f"{node}: no answer within {COMMAND_S:.0f} s: {line}") from None
        if done.returncode:
            said = done.stderr.decode(errors="replace").strip().splitlines()
            raise LiveError(
                f"{node}: {shlex.join(command)} ended with code {done.returncode}"
                f"{f' ({said[-1]})' if said else ''}"
            )
        return done.stdout

    def _prepare(self, node: str) -> None:
        folder = shlex.quote(self.there(node))
        text = self.processes.file.read_bytes()
        self.shell(node, f"rm -rf {folder} && mkdir -p {folder} && cat > {folder}/cell.yaml", text)
        python = shlex.quote(self.inventory.hosts[node].python)
        self.shell(node, f"cd {folder} && {python} -c 'import dwell'")

    # ------------------------------------------------------------------------- running

    def _restart_stamper(self) -> None:
        node = self.problem.stamper_node
        mark = f"{shlex.quote(self.there(node))}/{node}/stamper@{node}"
        number = f"""sed 's/.*"pid": *\\([0-9]*\\).*/\\1/' {mark}.pid"""
        self.shell(node, f"rm -f {mark}.book; kill -KILL $({number})")

    def fetch_runs(self) -> None:
        """Copy the controller's runs to this computer; raise a LiveError if there are none."""
        node = self.problem.controller_node
        data = self.shell(node, f"tar -C {shlex.quote(self.there(node))} -cf - runs")
        with tarfile.open(fileobj=io.BytesIO(data)) as archive:
            archive.extractall(self.folder, filter="data")

    # --------------------------------------------------------------------- disturbances

    def _apply_to_node(self, node: str, state: NodeState) -> None:
        # A ramp has more steps than the number of threads has values.
        if state.threads == self._threads.get(node, 0):
            return
        self._threads[node] = state.threads
        self._end_stress(node)
        if state.threads:
            line = self.inventory.hosts[node].stress.format(threads=state.threads)
            words = self._words(node, ["sh", "-c", line], whole=True)
            self.stress[node] = RemoteProcess(words, process_group=0)

    def _apply_to_link(self, name: str, now: Conditions) -> None:
        """Run the inventory's command that begins or ends a link's disturbance."""
        link, commands = self.problem.fabric.links[name], self.inventory.links[name]
        if asked := disturbance_of(link, now):
            self._disturbed.add(name)
            self.shell(link.source, commands.begin.format(**asked))
        elif name in self._disturbed:
            self._disturbed.remove(name)
            self.shell(link.source, commands.end)

    def _end_stress(self, node: str) -> None:
        if node in self.stress:
            end_all([self.stress.pop(node)], STOP_S)

    def _undisturb(self) -> None:
        for node in list(self.stress):
            self._end_stress(node)
        self._threads.clear()
        for name in sorted(self._disturbed):
            source = self.problem.fabric.links[name].source
            self.shell(source, self.inventory.links[name].end)
        self._disturbed.clear()


def require_commands(inventory: Inventory, scenario: Iterable[Disturbance]) -> None:
    """Raise a LiveError that lists a scenario's links without commands in the inventory."""
    links = {item.link for item in scenario if isinstance(item, LinkDisturbance)}
    missing = sorted(links - set(inventory.links))
    if missing:
        raise LiveError(
            f"the inventory has no commands that disturb {', '.join(missing)}; give them under "
            "`links`"
        )


def disturbance_of(link: Link, now: Conditions) -> dict[str, float]:
    """Return the values for a link's command; empty without a disturbance.

    ``loss_percent`` is the additional loss that, with the link's own, gives the requested loss.
    ``rate_mbps`` is infinite unless the requested rate is below the link's.
    """
    usual = usual_conditions(link)
    added = [pair for pair in zip(now.add_delays_ms, now.shares, strict=True) if pair[1]]
    variance = sum((share * delay.std) ** 2 for delay, share in added if isinstance(delay, Normal))
    loss = 1 - (1 - now.loss) / (1 - usual.loss)
    rate_mbps = now.rate_mbps if now.rate_mbps < usual.rate_mbps else math.inf
    if not added and loss < LEAST_LOSS and math.isinf(rate_mbps):
        return {}
    return {
        "mean_ms": round(sum(share * delay.expectation for delay, share in added), 3),
        "std_ms": round(variance**0.5, 3),
        "loss_percent": round(100 * max(loss, 0.0), 6),
        "rate_mbps": rate_mbps,
    }


def run_on_hosts(
    inventory: Inventory,
    problem: Problem,
    *,
    scenario: str,
    policy: str,
    seconds: float,
    seed: int,
    out: Path,
    name: str,
    jobs: bool = False,
) -> Path:
    """Run a cell on real hosts, and return the folder of its run on this computer.

    Parameters
    ----------
    seconds : float
        Duration from the first release, including the warm-up.
    seed : int
        Seed of the episodes of disturbances; delays and losses are the real links'.
    out : Path
        Folder for logs and the run; the folder of an earlier run is replaced.
    jobs : bool
        Whether the run records its jobs.

    Raises
    ------
    DwellError
        If the hosts do not support the scenario, or the cell does not start.
    """
    problem = problem.under(policy)
    by_name(problem.controller.policy, resolved(problem, estimator_of(problem)))
    timeline = timeline_of(problem, scenario, seed=seed, seconds=seconds)
    hosts = RealHosts(problem, inventory, out, name=name, more=["--jobs"] if jobs else [])
    require_commands(inventory, timeline.items)
    make_folder(out, MARK, "a testbed's")
    played = Played(problem, scenario, seed, timeline)
    try:
        hosts.start()
        play_on(hosts, played, seconds)
        hosts.processes.stop_controller()
        hosts.fetch_runs()
    finally:
        hosts.stop()
    folder = require_run(out)
    release_ns = open_run(folder).cycles["release_ns"]
    last_ns = hosts.begun_ns + (int(release_ns[-1]) if len(release_ns) else 0)
    played.note(folder, (hosts.begun_ns, last_ns))
    shutil.rmtree(out / STARTING, ignore_errors=True)
    return folder
