"""Runs of a campaign that are simulated: what a campaign does with runs needs no testbed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import dwell
from dwell.errors import LiveError
from dwell.model import Problem
from dwell.record import seal_run
from dwell_lab.testbed.idle import Idle, Quiet


def ALWAYS_IDLE(quiet: Quiet) -> Idle:  # noqa: N802 (stands for a value)
    """Say that the machine is idle, without looking."""
    return Idle(True, quiet.for_s, 0.0, 0.0)


class SimulatedRuns:
    """Plays runs on the simulator, and can be told which attempts to spoil.

    Parameters
    ----------
    broken : callable, optional
        Takes the names of all attempts so far, this one's last; returns ``error`` for a cell that
        does not come up, ``pressure`` for a run under pressure, ``stop`` for Ctrl-C.
    """

    def __init__(self, broken: Callable[[Sequence[str]], str] | None = None) -> None:
        self.broken = broken or (lambda names: "")
        self.names: list[str] = []
        self.asked: list[dict[str, Any]] = []

    def __call__(
        self,
        problem: Problem,
        *,
        scenario: str,
        policy: str,
        seconds: float,
        seed: int,
        out: Path,
        name: str,
        jobs: bool,
    ) -> Path:
        """Return the folder of a run."""
        assert name == "campaign"
        name = f"{scenario}-{policy}-{seed}"
        self.names.append(name)
        self.asked.append({"scenario": scenario, "policy": policy, "seed": seed, "out": out})
        spoilt = self.broken(self.names)
        (out / "agent.log").write_text("started\n", encoding="utf-8")
        if spoilt == "error":
            raise LiveError("the cell is not complete")
        if spoilt == "stop":
            raise KeyboardInterrupt
        window_s = problem.window_cycles * problem.pipeline.period_ms / 1e3
        run = dwell.simulate(
            problem,
            scenario=scenario,
            policy=policy,
            seed=seed,
            windows=int(seconds / window_s),
            jobs=jobs,
        )
        folder = run.save(out / "runs" / name)
        excluded = [problem.warmup_windows] if not spoilt else list(range(run.windows.height))
        told = {"excluded": excluded, "failed": spoilt == "pressure"}
        seal_run(folder, pressure=told, scenario=scenario, seed=seed)
        return folder
