"""Sizes of what is installed, and CPU time of building the kernel."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement

from benchmarks.figures import Figure, Goal, Section
from benchmarks.timing import ROOT, run_timed

MB = 1e6
BUILD = (sys.executable, "-m", "hatchling", "build", "-t")


def measure(quick: bool) -> Section:
    """Megabytes, and seconds."""
    figures = [Figure("installed with [sim], Dwell aside", [_installed({"sim"}) / MB], "MB")]
    notes = []
    with tempfile.TemporaryDirectory() as folder:
        source = unpack_source(Path(folder))
        command = [*BUILD, "wheel"]
        spent = []
        for _ in range(1 if quick else 3):
            shutil.rmtree(source / "build", ignore_errors=True)
            spent.append(run_timed(command, folder=source)[1].cpu_s)
        figures.append(
            Figure("building the kernel and a wheel, CPU time", spent, "s", Goal(high=10))
        )
        (wheel,) = (source / "dist").glob("*.whl")
        figures.append(Figure("wheel", [wheel.stat().st_size / MB], "MB", Goal(high=1.5)))
        notes.append(wheel.name)
    return Section("Installing", figures, notes)


def unpack_source(folder: Path) -> Path:
    """Build the source distribution, unpack it in a folder, and return its tree."""
    subprocess.run([*BUILD, "sdist", "-d", folder], cwd=ROOT, check=True, capture_output=True)
    (archive,) = folder.glob("dwell_placement-*.tar.gz")
    shutil.unpack_archive(archive, folder, filter="data")
    return folder / archive.name.removesuffix(".tar.gz")


def _installed(extras: set[str]) -> int:
    """Bytes of the distributions that Dwell needs with these extras."""
    sizes: dict[str, int] = {}
    asked = [("dwell-placement", extras)]
    while asked:
        name, of = asked.pop()
        for text in distribution(name).requires or ():
            needed = Requirement(text)
            marker = needed.marker
            if marker and not any(marker.evaluate({"extra": extra}) for extra in (of or {""})):
                continue
            if needed.name in sizes:
                continue
            try:
                files = distribution(needed.name).files or ()
            except PackageNotFoundError:
                continue
            paths = [Path(str(file.locate())) for file in files]
            sizes[needed.name] = sum(path.stat().st_size for path in paths if path.is_file())
            asked.append((needed.name, needed.extras))
    return sum(sizes.values())
