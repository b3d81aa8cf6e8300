"""Names of testbeds: one running testbed per name, and removal of a dead testbed's leftovers.

A folder that is lost at reboot contains two files per name. ``NAME.lock`` is locked while its owner
lives. ``NAME.json`` lists the namespaces that the owner will create, and is written before they
exist. The next owner of the name removes these, and the name's control group, if they remain.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import cast

from dwell.errors import LiveError
from dwell.files import write_whole
from dwell.live.local.cgroups import Cgroups, find_cgroups
from dwell.live.local.child import Started
from dwell_lab.testbed.groups import group_name, remove_group
from dwell_lab.testbed.hosts import namespace_name, namespace_path, remove_namespace

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,39}")


def claims_folder() -> Path:
    """Return the folder of the names: ``/run/dwell``, or below the user's runtime folder."""
    if os.geteuid() == 0:
        return Path("/run/dwell")
    return Path(os.environ.get("XDG_RUNTIME_DIR") or f"/run/user/{os.geteuid()}", "dwell")


class Claim(Started):
    """Context manager that holds the right to create the hosts and groups of one name.

    Enter it before the hosts and groups are created. It removes the hosts and groups that a dead
    testbed with the same name left. A running testbed removes its own hosts and groups.

    Parameters
    ----------
    name : str
        Name of the testbed.
    nodes : sequence of str
        Nodes that will have a network namespace and a group.
    folder : Path, optional
        Folder of the names.

    Raises
    ------
    LiveError
        If the name is invalid.
    """

    def __init__(self, name: str, nodes: Sequence[str], *, folder: Path | None = None) -> None:
        if not NAME.fullmatch(name):
            raise LiveError(
                f"a testbed cannot be named {name!r}: up to 40 letters, digits, - and _, the first "
                "a letter or a digit"
            )
        super().__init__()
        self.name = name
        self._namespaces = [namespace_name(name, node) for node in nodes]
        folder = claims_folder() if folder is None else folder
        self._lock, self._record = folder / f"{name}.lock", folder / f"{name}.json"
        self._handle: int | None = None

    def _start(self) -> None:
        """Take the name, once; if another process holds it, raise and change nothing."""
        if self._handle is not None:
            return
        try:
            self._lock.parent.mkdir(parents=True, exist_ok=True)
            self._handle = self._open()
        except OSError as error:
            raise LiveError(f"{self._lock}: {error.strerror}") from None
        self._clear()
        self._require_free()
        record = json.dumps({"pid": os.getpid(), "namespaces": self._namespaces})
        write_whole(self._record, record, durable=False)

    def stop(self) -> None:
        """Remove any leftovers, and release the name."""
        if self._handle is None:
            return
        try:
            self._clear()
        finally:
            self._lock.unlink(missing_ok=True)  # still locked: no other process holds it
            os.close(self._handle)
            self._handle = None

    def _open(self) -> int:
        while True:
            # Child processes do not inherit the lock: they may live longer than their testbed.
            handle = os.open(self._lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if _same(handle, self._lock):
                    os.ftruncate(handle, 0)
                    os.write(handle, f"{os.getpid()}\n".encode())
                    return handle
            except BlockingIOError:
                owner = os.pread(handle, 20, 0).decode().strip() or "unknown"
                os.close(handle)
                raise LiveError(
                    f"a testbed named {self.name!r} runs already (process {owner}); wait for it, "
                    "end it, or use another name"
                ) from None
            except BaseException:
                os.close(handle)
                raise
            os.close(handle)  # its owner has just removed it

    def _clear(self) -> None:
        """Remove the hosts and groups that the record lists, and then the record."""
        try:
            record = cast("dict[str, list[str]]", json.loads(self._record.read_text()))
        except FileNotFoundError:
            return
        except ValueError:  # from another version, or edited
            raise LiveError(f"{self._record} is not a testbed's record; remove it") from None
        if cgroups := _cgroups():
            remove_group(group_name(self.name), cgroups)
        for namespace in record.get("namespaces", []):
            remove_namespace(namespace)
        self._record.unlink(missing_ok=True)

    def _require_free(self) -> None:
        taken = [
            f"network namespace {name} (ip netns delete {name})"
            for name in self._namespaces
            if namespace_path(name).exists()
        ]
        if cgroups := _cgroups():
            folders = cgroups.groups(group_name(self.name))
            taken += [f"group {folder}" for folder in folders if folder.exists()]
        if taken:
            raise LiveError(
                f"the name {self.name!r} is taken, by none that a testbed of this name left: "
                f"{'; '.join(taken)}; remove these, or use another name"
            )


def _same(handle: int, path: Path) -> bool:
    """Whether a path still names the file of an open handle."""
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(handle), path.stat())
    return False


def _cgroups() -> Cgroups | None:
    """Return the control groups, or None; the doctor and `Groups` report that they are missing."""
    with suppress(LiveError):
        return find_cgroups()
    return None
