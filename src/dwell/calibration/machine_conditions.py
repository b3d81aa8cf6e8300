"""Conditions of the machine during a measurement, from Linux."""

from __future__ import annotations

import os
import platform
import re
import resource
import time
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

#: Share of the time of a CPU that may go to other virtual machines.
STOLEN_MOST = 0.02


@dataclass(frozen=True, slots=True)
class MachineConditions:
    """Load, frequency and disturbances of the machine during a measurement; None if unknown.

    Parameters
    ----------
    load : float
        Load average of the machine over the minute before the measurement.
    cpus : int
        Number of CPUs of the machine.
    governor : str or None
        Frequency governor of the first core.
    frequency_mhz : tuple of float or None
        Frequency of the first core, before and after.
    steal : float or None
        Share of the cores' time that the hypervisor gave to other virtual machines.
    preemptions : int
        Involuntary context switches of this process.
    cpu_s : float
        CPU time of all threads of this process, in seconds.
    """

    load: float
    cpus: int
    governor: str | None
    frequency_mhz: tuple[float | None, float | None]
    steal: float | None
    preemptions: int
    cpu_s: float


class MachineCounters:
    """Counters of the cores and this process at the start of a measurement."""

    def __init__(self, cores: Collection[int]) -> None:
        self._cores = sorted(cores)
        self._load = os.getloadavg()[0]
        self._frequency_mhz = _frequency_mhz(self._cores[0])
        self._ticks = _ticks(self._cores)
        self._cpu_s = time.process_time()
        self._preemptions = resource.getrusage(resource.RUSAGE_SELF).ru_nivcsw

    def conditions(self) -> MachineConditions:
        """Return the conditions since the counters were read."""
        preemptions = resource.getrusage(resource.RUSAGE_SELF).ru_nivcsw - self._preemptions
        cpu_s = time.process_time() - self._cpu_s
        ticks = _ticks(self._cores)
        steal = None
        if ticks is not None and self._ticks is not None and ticks[1] > self._ticks[1]:
            steal = (ticks[0] - self._ticks[0]) / (ticks[1] - self._ticks[1])
        return MachineConditions(
            load=self._load,
            cpus=os.cpu_count() or 1,
            governor=_of_cpu(self._cores[0], "scaling_governor") or None,
            frequency_mhz=(self._frequency_mhz, _frequency_mhz(self._cores[0])),
            steal=steal,
            preemptions=preemptions,
            cpu_s=cpu_s,
        )


def processor() -> str:
    """Return the name of the processor, or its architecture if Linux gives no name."""
    match = re.search(r"^(?:model name|Model)\s*:\s*(.+)$", text_of("/proc/cpuinfo"), re.MULTILINE)
    return match[1].strip() if match else platform.machine()


def _of_cpu(core: int, name: str) -> str:
    return text_of(f"/sys/devices/system/cpu/cpu{core}/cpufreq/{name}").strip()


def _frequency_mhz(core: int) -> float | None:
    kilohertz = _of_cpu(core, "scaling_cur_freq")
    if kilohertz.isdigit():
        return int(kilohertz) / 1e3
    for block in text_of("/proc/cpuinfo").split("\n\n"):
        if re.search(rf"^processor\s*:\s*{core}$", block, re.MULTILINE):
            match = re.search(r"^cpu MHz\s*:\s*([\d.]+)$", block, re.MULTILINE)
            return float(match[1]) if match else None
    return None


def _ticks(cores: Collection[int]) -> tuple[int, int] | None:
    """Return stolen and all clock ticks of `cores` since the machine started."""
    stolen = total = 0
    for core in cores:
        match = re.search(rf"^cpu{core} ([\d ]+)$", text_of("/proc/stat"), re.MULTILINE)
        # user nice system idle iowait irq softirq steal; guests are in user and nice already
        ticks = [] if match is None else [int(word) for word in match[1].split()[:8]]
        if len(ticks) < 8:
            return None
        stolen += ticks[7]
        total += sum(ticks)
    return stolen, total


def text_of(path: str) -> str:
    """Return the content of a file of the kernel; empty if it does not exist."""
    try:
        return Path(path).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
