"""Kept cell: copy of a cell file and of the modules next to it, made at the start of a node.

All processes of the node read the copy. An edited file has an effect after `dwell live up --again`,
or after the node has ended cleanly.
"""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import importlib.util
import re
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from types import ModuleType
from typing import Literal, TypeAlias

import msgspec

from dwell.cellfile import load, load_without_traces
from dwell.errors import DwellError, LiveError
from dwell.files import write_whole
from dwell.live.failures import start_repeating
from dwell.live.host.state_files import boot_id, make_folder
from dwell.model import FrozenDict, Problem
from dwell.model.document import digests
from dwell.version import __version__

#: Part of a cell that a change affects: comments only, the controller, stage code, all processes.
Change: TypeAlias = Literal["text", "decision", "code", "wiring"]
#: Folder of the copy in a state folder, and its description.
FOLDER, INDEX = "cell", "cell.json"
#: Time between two comparisons with the files.
COMPARE_S = 2.0
#: Modules that a cell file names, as ``package.module:Name``.
NAMED = re.compile(rb"(\w+)(?:\.\w+)*:\w")


def installed_version() -> str:
    """Return the installed version of Dwell, which may be newer than this process."""
    text = files("dwell").joinpath("version.py").read_text(encoding="utf-8")
    found = re.search(r'__version__ = "(.+)"', text)
    return found[1] if found else __version__


class _Index(msgspec.Struct, frozen=True):
    """Description of a copy: cell file, Unix time, Dwell's version, boot id of a clean end."""

    file: str
    since_s: float
    version: str
    ended: str = ""


@dataclass(frozen=True, slots=True)
class KeptCell:
    """Bytes of a cell's files: `contents`, by path relative to the folder of the cell file.

    `since_s` is the Unix time at which they were read, `version` the version of Dwell at that time.
    `folder` is the state folder with the copy; None if the bytes come from the files themselves.
    """

    file: Path
    contents: Mapping[str, bytes]
    since_s: float
    folder: Path | None = None
    version: str = field(default_factory=installed_version)

    def __post_init__(self) -> None:
        object.__setattr__(self, "contents", FrozenDict(self.contents))

    @classmethod
    def of(cls, file: Path, folders: Iterable[Path] = ()) -> KeptCell:
        """Return the copy in the first state folder with a valid copy, else read the files.

        A copy is invalid if its node has ended cleanly in this boot.
        """
        file = file.resolve()
        for folder in folders:
            with suppress(OSError, msgspec.MsgspecError):
                index = msgspec.json.decode((folder / INDEX).read_bytes(), type=_Index)
                if index.file == str(file) and index.ended != _this_boot():
                    kept = folder / FOLDER
                    paths = [path for path in sorted(kept.rglob("*")) if path.is_file()]
                    contents = {str(path.relative_to(kept)): path.read_bytes() for path in paths}
                    return cls(file, contents, index.since_s, folder, index.version)
        return cls(file, _contents(file), time.time())

    def write(self, folder: Path) -> None:
        """Write the copy; after an OSError or LiveError the state folder has no valid copy."""
        make_folder(folder)
        (folder / INDEX).unlink(missing_ok=True)
        kept = folder / FOLDER
        if kept.exists():
            shutil.rmtree(kept)
        for name, content in self.contents.items():
            make_folder((kept / name).parent)
            write_whole(kept / name, content)
        self._write_index(folder)

    def end(self, folder: Path) -> None:
        """Record a clean end of the node: a start in the same boot reads the files again.

        After a shutdown, which also ends nodes cleanly, the copy stays valid in the next boot.
        """
        with suppress(OSError):
            self._write_index(folder, ended=_this_boot())

    def _write_index(self, folder: Path, *, ended: str = "") -> None:
        index = _Index(str(self.file), self.since_s, self.version, ended)
        write_whole(folder / INDEX, msgspec.json.encode(index))

    def problem(self, *, traces: bool = False) -> Problem:
        """Return the problem of the cell file; traces come from the original folder.

        Raises a DwellError if the cell file has an error.
        """
        file, home = self.file, self.file.parent
        if self.folder is not None:
            file = self.folder / FOLDER / file.name
        problem = load(file, traces=home) if traces else load_without_traces(file)
        return replace(problem, folder=str(home))

    def install(self) -> None:
        """Import the kept modules in this process; other modules come from the cell's folder."""
        sys.path.insert(0, str(self.file.parent))
        sys.meta_path.insert(0, _KeptModules(self))

    def paths(self) -> Iterator[Path]:
        """Return the paths of the original files."""
        return map(self.file.parent.joinpath, self.contents)

    def changed(self) -> list[str]:
        """Return the names of the files that have changed or vanished."""
        now = _contents(self.file)
        return [name for name, content in self.contents.items() if now.get(name) != content]

    def told(self, where: str) -> str:
        """Return a sentence that lists the changed files; empty if none has changed."""
        if not (changed := self.changed()):
            return ""
        began = time.localtime(self.since_s)
        today = began[:3] == time.localtime()[:3]
        since = time.strftime("%H:%M" if today else "%Y-%m-%d %H:%M", began)
        one = len(changed) == 1
        return (
            f"{', '.join(changed[:3])}{', ...' if len(changed) > 3 else ''} on {where} "
            f"{'has' if one else 'have'} changed since {since}; `dwell live up --again` takes "
            f"{'it' if one else 'them'} over"
        )


def change(old: KeptCell, new: KeptCell) -> Change:
    """Return the widest effect of the differences; raises a DwellError for an invalid cell file."""
    problems = old.problem(), new.problem()
    before, after = map(digests, problems)
    differ = {part for part in before if before[part] != after[part]}
    series = {kept.version.rpartition(".")[0] for kept in (old, new)}
    is_renamed = problems[0].name != problems[1].name
    if is_renamed or differ & {"wiring", "hosts"} or len(series) > 1:
        return "wiring"
    modules = [{**kept.contents, kept.file.name: b""} for kept in (old, new)]
    if modules[0] != modules[1] or "code" in differ or old.version != new.version:
        return "code"
    return "decision" if differ else "text"


def cell_here(file: Path, root: Path) -> KeptCell:
    """Return this computer's copy of a cell, else read the files.

    `root` has one folder per cell, and in it one state folder per node.
    """
    return KeptCell.of(file, sorted(root.glob("*/*")))


def forget(file: Path, root: Path) -> None:
    """Invalidate a cell's copies on this computer: the next start of each node reads the files."""
    for folder in root.glob("*/*"):
        if KeptCell.of(file, [folder]).folder is not None:
            (folder / INDEX).unlink(missing_ok=True)


class CellKeeper:
    """Copies a cell to a node's state folder, and compares the copy with the files regularly."""

    def __init__(
        self, kept: KeptCell, folder: Path, where: str, say: Callable[[str], None]
    ) -> None:
        self.kept, self.folder = kept, folder
        self._where, self._say = where, say
        self._lock = threading.Lock()
        #: Restarts the processes of a node.
        self.renew: Callable[[], object] = str
        #: Whether the agent has to replace itself, because Dwell's installed version has changed.
        self.replaced = False
        self._sentence = self._trouble = ""
        self._marks: tuple[object, ...] = ()

    def told(self) -> str:
        """Return a sentence about a failed copy or changed files; empty without either."""
        return self._trouble or self._sentence

    def begin(self, stopped: threading.Event) -> None:
        """Write the copy, and compare it with the files in a thread until `stopped` is set."""
        self.look()
        start_repeating("cell file", COMPARE_S, stopped, self.look)

    def take_over(self, check: Callable[[KeptCell], object] = str) -> Change | None:
        """Replace the copy by the present files, and return the change.

        If the wiring differs, or `check` raises a DwellError, keep the old copy, log the reason and
        return None.
        """
        name, new = self.kept.file.name, KeptCell.of(self.kept.file)
        try:
            found = change(self.kept, new)
            if found == "wiring":
                raise LiveError("its wiring is another; end the cell on all nodes, and start it")
            check(new)
            with self._lock:
                self._keep(new)
        except (DwellError, OSError) as error:
            self._say(f"error: {name}: is not taken over: {error}")
            return None
        self._say(f"{name}: is taken over ({found})")
        self.look()
        self.replaced = new.version != __version__
        if found == "code" and not self.replaced:
            self.renew()
        return found

    def _keep(self, kept: KeptCell) -> None:
        kept.write(self.folder)
        self.kept = replace(kept, folder=self.folder)
        self._marks = ()

    def look(self) -> None:
        """Write the copy if it is missing, and compare it with the files."""
        with self._lock:
            self._look()

    def _look(self) -> None:
        trouble, sentence = "", self._sentence
        try:
            if self.kept.folder is None or not (self.folder / INDEX).exists():
                self._keep(self.kept)
        except (OSError, LiveError) as error:
            trouble = f"{self.kept.file.name} cannot be kept: {error}"
        # Keep the last sentence if a file cannot be read.
        with suppress(OSError):
            # Also write a new sentence at midnight, when it gets a date.
            marks = (time.localtime()[:3], *map(_mark, self.kept.paths()))
            if marks != self._marks:
                sentence = self.kept.told(self._where)
                self._marks = marks
        for line, before in ((trouble, self._trouble), (sentence, self._sentence)):
            if line and line != before:
                self._say(f"warning: {line}")
        self._trouble, self._sentence = trouble, sentence

    def end(self) -> None:
        """Record a clean end of the node."""
        self.kept.end(self.folder)


class _KeptModules(importlib.abc.MetaPathFinder):
    """Finds kept modules before all others, under the names of their files."""

    def __init__(self, kept: KeptCell) -> None:
        self._kept, self._home = kept, kept.file.parent

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return the spec of a kept module, else None (see `importlib`)."""
        place = Path(*fullname.split("."))
        if path is not None and str(self._home / place.parent) not in path:
            return None
        for name in (place / "__init__.py", place.with_suffix(".py")):
            content = self._kept.contents.get(str(name))
            if content is not None:
                file = self._home / name
                inside = [str(file.parent)] if file.name == "__init__.py" else None
                return importlib.util.spec_from_file_location(
                    fullname,
                    file,
                    loader=_KeptSource(str(file), content),
                    submodule_search_locations=inside,
                )
        return None


class _KeptSource(importlib.abc.SourceLoader):
    """Loader of a kept module, whose ``__file__`` is the original file, next to its data files."""

    def __init__(self, file: str, content: bytes) -> None:
        self._file, self._content = file, content

    def get_filename(self, fullname: str) -> str:
        """Return the path of the original file."""
        return self._file

    def get_data(self, path: str | bytes) -> bytes:
        """Return the kept source of the module, or read another file from the disk."""
        return self._content if path == self._file else Path(str(path)).read_bytes()


def _contents(file: Path) -> dict[str, bytes]:
    """Return the bytes of a cell file and of the readable modules next to it.

    These are the modules in its folder, packages with an ``__init__.py``, and packages that the
    cell file names.
    """
    home = file.parent
    contents: dict[str, bytes] = {}
    if file.is_file():
        with suppress(FileNotFoundError, PermissionError):
            contents[file.name] = file.read_bytes()
    packages = {path.parent for path in home.glob("*/__init__.py")}
    packages |= {home / name.decode() for name in NAMED.findall(contents.get(file.name, b""))}
    modules = {*home.glob("*.py"), *(path for one in packages for path in one.rglob("*.py"))}
    for path in sorted(one for one in modules if one.is_file()):
        with suppress(FileNotFoundError, PermissionError):
            contents[str(path.relative_to(home))] = path.read_bytes()
    return contents


def _mark(path: Path) -> tuple[int, int, int] | None:
    """Return values that differ after each change of a file; None if it is missing.

    Programs can set `st_mtime_ns` back, but not `st_ctime_ns`.
    """
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ctime_ns, status.st_size, status.st_ino


def _this_boot() -> str:
    """Return the id of the kernel's boot; never empty, as an empty id means a running node."""
    return boot_id() or "unknown"
