"""Control groups of this machine: cgroup v2, or the controllers of v1."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from dwell.errors import LiveError
from dwell.live.roles.control_group import cgroup_mounts

#: Required controllers of v1, and all controllers that are used if mounted.
NEEDED = ("cpu", "cpuacct")
USED = (*NEEDED, "cpuset", "freezer")


@dataclass(frozen=True, slots=True)
class Cgroups:
    """Hierarchies for new groups: the top folder by controller (with v2 one for all)."""

    version: int
    folders: Mapping[str, Path]

    def groups(self, *names: str) -> list[Path]:
        """Return the folders of a group, one per hierarchy, even if they do not exist yet."""
        # v1 may have two controllers in one hierarchy.
        return [top.joinpath(*names) for top in dict.fromkeys(self.folders.values())]

    def __str__(self) -> str:
        """Return version and controllers, for messages."""
        return f"cgroup v{self.version} with {', '.join(self.folders)}"


def find_cgroups(mounts: Path = Path("/proc/self/mountinfo")) -> Cgroups:
    """Return the hierarchies with the controller ``cpu``: v2 if it has ``cpu``, else v1.

    Raises a LiveError if neither has it.
    """
    try:
        mounted = list(cgroup_mounts(mounts.read_text()))
    except OSError as error:
        raise LiveError(f"{mounts} cannot be read ({error.strerror})") from None
    for kind, _, _, top in mounted:
        if kind == "cgroup2" and "cpu" in (has := _controllers(top)):
            return Cgroups(2, {name: top for name in ("cpu", "cpuset") if name in has})
    folders: dict[str, Path] = {}
    for kind, options, _, top in mounted:
        if kind == "cgroup":
            folders.update({name: top for name in USED if name in options})
    missing = [name for name in NEEDED if name not in folders]
    if not missing:
        return Cgroups(1, {name: folders[name] for name in USED if name in folders})
    raise LiveError(
        "no control groups for the CPU: no cgroup v2 with the controller cpu is mounted, nor "
        f"cgroup v1 with {' and '.join(missing)}; in a container, start it with "
        "--privileged --cgroupns=host -v /sys/fs/cgroup:/sys/fs/cgroup"
    )


def _controllers(top: Path) -> list[str]:
    try:
        return (top / "cgroup.controllers").read_text().split()
    except OSError:
        return []
