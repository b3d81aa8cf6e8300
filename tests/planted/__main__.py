"""Plant each fault in a copy of the tree, and see that the tests find it: `make planted`."""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import Queue
from tempfile import TemporaryDirectory

from tests.planted.catalogue import ROOT, Fault, catalogue, section_of

#: Time after which tests that a fault keeps from ending are stopped, seconds.
PATIENCE_S = 600
#: What pytest ends with where all tests have passed, and where one has failed.
PASSED, FAILED = 0, 1

LIBRARY = Path("src/dwell/kernels/libdwell_kernel.so")
BUILD = "import hatch_build as h; h.build(h.find_compiler(), h.KERNELS / h.FILE['NAME'])"
IMPORTED = "import dwell; print(dwell.__file__)"


@dataclass(frozen=True, slots=True)
class Outcome:
    """What has become of a planted fault.

    Parameters
    ----------
    result : str
        ``found``, ``survived``, or why nothing can be said.
    by : str
        The test that has found it.
    """

    fault: Fault
    place: str
    result: str
    by: str
    seconds: float

    @property
    def row(self) -> str:
        """The outcome as a row of the table."""
        cells = (self.fault.fault, self.place, self.result, self.by, f"{self.seconds:.0f}")
        return f"| {' | '.join(cells)} |"


class Copy:
    """A copy of the tree, in which the sources are changed and tested."""

    def __init__(self, root: Path) -> None:
        self.root = root
        listed = _run(["git", "ls-files", "-co", "--exclude-standard", "-z"], ROOT).stdout
        for name in filter(None, listed.split("\0")):
            if (ROOT / name).is_file():
                (root / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, root / name)
        shutil.copy2(ROOT / LIBRARY, root / LIBRARY)
        imported = Path(self.python("-c", IMPORTED).stdout.strip())
        if not imported.is_relative_to(root):
            sys.exit(f"the tests would be of {imported}, and not of the copy in {root}")

    def python(
        self, *arguments: str, patience_s: float | None = PATIENCE_S
    ) -> subprocess.CompletedProcess[str]:
        """Run Python with the copy's package."""
        return _run([sys.executable, *arguments], self.root, patience_s)

    def test(
        self, ids: Iterable[str], *options: str, patience_s: float | None = PATIENCE_S
    ) -> tuple[int, list[str]]:
        """Run tests; returns how pytest ended, and which tests have failed."""
        # What Python has compiled is told from older sources by the second of their change; no two
        # runs begin within one.
        options = ("-p", "no:cacheprovider", "--tb=no", *options)
        done = self.python("-m", "pytest", *options, *ids, patience_s=patience_s)
        return done.returncode, re.findall(r"^FAILED (.+?)(?: - .*)?$", done.stdout, re.MULTILINE)

    def plant(self, fault: Fault) -> tuple[str, str]:
        """Plant a fault and run its tests; returns the result, and the test that has found it."""
        if flaw := fault.flaw(self.root):
            return f"does not apply: {flaw}", ""
        file, library = self.root / fault.path, self.root / LIBRARY
        before = file.read_text(encoding="utf-8")
        built = library.read_bytes()
        file.write_text(before.replace(fault.text, fault.planted), encoding="utf-8")
        try:
            if fault.is_compiled and self.python("-c", BUILD).returncode:
                return "does not apply: the kernel cannot be built with it", ""
            code, failed = self.test(fault.tests, "-x")
        except subprocess.TimeoutExpired:
            return f"its tests take more than {PATIENCE_S} s", ""
        finally:
            file.write_text(before, encoding="utf-8")
            if fault.is_compiled:
                library.unlink()
                library.write_bytes(built)
        if code == PASSED:
            return "survived", ""
        if code == FAILED and failed:
            return "found", failed[0]
        return f"pytest ended with {code}", ""


def _run(
    command: Sequence[str], folder: Path, patience_s: float | None = None
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command,
        cwd=folder,
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join(str(folder / name) for name in ("src", "lab/src")),
        },
        capture_output=True,
        text=True,
        check=False,
        timeout=patience_s,
    )


def main() -> int:
    """Return 1 where a fault has survived, or could not be planted."""
    parser = argparse.ArgumentParser(prog="python -m tests.planted", description=__doc__)
    parser.add_argument("-n", type=int, default=2, help="copies that are tested side by side")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="faults, by name")
    asked = parser.parse_args()
    every = [
        (fault, f"{Path(page).name}: {section_of(fault, page)}")
        for page, faults in catalogue().items()
        for fault in faults
    ]
    chosen = [one for one in every if asked.only is None or one[0].fault in asked.only]
    if unknown := set(asked.only or ()) - {fault.fault for fault, _ in chosen}:
        parser.error(f"no fault {', '.join(sorted(unknown))}")

    with TemporaryDirectory(prefix="dwell-planted-") as folder:
        copies = Queue[Copy]()
        for number in range(min(asked.n, len(chosen))):
            copies.put(Copy(Path(folder).resolve() / str(number)))

        def plant(one: tuple[Fault, str]) -> Outcome:
            copy, begun_s = copies.get(), time.monotonic()
            try:
                result, by = copy.plant(one[0])
            finally:
                copies.put(copy)
            outcome = Outcome(*one, result, by, time.monotonic() - begun_s)
            print(outcome.row, flush=True)
            return outcome

        print("| fault | promise | result | by | s |\n|---|---|---|---|---|", flush=True)
        with ThreadPoolExecutor(asked.n) as threads:
            outcomes = list(threads.map(plant, chosen))
        # A test that fails anyway finds nothing.
        finders = sorted({one.by for one in outcomes if one.by})
        failing = copies.get().test(finders, "-n", str(asked.n), patience_s=None)[1]
    found = [one for one in outcomes if one.result == "found" and one.by not in failing]
    wrong = [one.fault.fault for one in outcomes if one not in found]
    print(f"\n{len(found)} of {len(outcomes)} found; not: {', '.join(wrong) or 'none'}")
    if failing:
        print(f"tests that fail without a fault, too: {', '.join(failing)}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
