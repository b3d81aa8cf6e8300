"""The pictures of the pages, from examples: `python -m docs.gallery` makes them again (minutes).

`--check` makes them elsewhere, and fails if the data of a picture differ from the kept data.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"


class Picture(NamedTuple):
    """A picture: its name, the commands that make it, its figure, and the figure's data."""

    name: str
    commands: tuple[str, ...]
    figure: str
    data: str


PICTURES = (
    Picture(
        "simulated",
        (
            "dwell study examples/studies/first.yaml",
            "dwell report studies/first --figures figures",
        ),
        "violation_rate.svg",
        "violation_rate.csv",
    ),
    Picture(
        "own-policy",
        (
            "dwell new hall",
            "dwell run hall/cell.yaml --scenario edge-cpu-stress --policy policy:Patient+profile"
            " --windows 40 --out runs/own",
            "dwell report runs/own --figures figures",
        ),
        "time.svg",
        "time-windows.csv",
    ),
    Picture(
        "capacity",
        (
            "dwell fleet capacity examples/fleet.yaml --policy SO --phases even --what-if"
            " --figures figures",
        ),
        "capacity.svg",
        "capacity.csv",
    ),
    Picture(
        "replicas",
        ("python -m docs.replicas --out figures",),
        "replicas.svg",
        "replicas.csv",
    ),
    Picture(
        "cloud-map",
        (
            "dwell study examples/studies/clouds.yaml",
            "python -m docs.cloud_map studies/clouds --out figures",
        ),
        "cloud-map.svg",
        "cloud-map.csv",
    ),
)


def make(picture: Picture, folder: Path) -> tuple[Path, Path]:
    """Make a picture in an empty folder; return its figure and its data."""
    (folder / "examples").symlink_to(ROOT / "examples")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for command in picture.commands:
        subprocess.run(
            command.split(),
            cwd=folder,
            env={**os.environ, "PATH": path, "PYTHONPATH": str(ROOT)},
            check=True,
            stdout=subprocess.DEVNULL,
        )
    return folder / "figures" / picture.figure, folder / "figures" / picture.data


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the pictures, or compare their data; return 1 if data differ."""
    parser = argparse.ArgumentParser(prog="python -m docs.gallery", description=__doc__)
    parser.add_argument("--check", action="store_true", help="compare the data, write nothing")
    parser.add_argument("--only", default="", help="pictures whose name contains this")
    given = parser.parse_args(arguments)
    differing = []
    for picture in PICTURES:
        if given.only not in picture.name:
            continue
        with TemporaryDirectory() as name:
            figure, data = make(picture, Path(name))
            kept = IMAGES / f"{picture.name}.csv"
            if given.check:
                if kept.read_bytes() != data.read_bytes():
                    differing.append(picture.name)
            else:
                shutil.copyfile(figure, IMAGES / f"{picture.name}.svg")
                shutil.copyfile(data, kept)
    if differing:
        print(f"other data: {', '.join(differing)}", file=sys.stderr)
    return int(bool(differing))


if __name__ == "__main__":
    sys.exit(main())
