"""What a release needs beyond the tests: `make release-check`.

Builds a wheel per processor, and looks at each with auditwheel. Installs the wheel with the pinned
packages in each Python of this computer and simulates a packaged example; for other versions it
looks up whether each pinned package has a wheel. Makes the gallery again, and compares its data.
Then it does what README says as a stranger: a clone in an empty folder and an empty home folder,
with no variables except those by which this computer reaches a package index.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).parents[1]
UV = Path(sys.executable).with_name("uv")
VERSIONS = ("3.11", "3.12", "3.13", "3.14")
PLATFORMS = ("manylinux_2_17_x86_64", "manylinux_2_17_aarch64")
PINS = ROOT / "requirements" / "runtime.txt"
BLOCK = re.compile(r"^```(?:sh|console)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
#: Commands of README that a stranger's way leaves out: they take minutes.
LEFT_OUT = ("make test", "make demo")
#: Variables of a computer by which it reaches a package index.
REACHES_INDEX = re.compile(r"SSL_CERT_|PIP_|UV_|(?:https?|no)_proxy$", re.IGNORECASE)


def run(
    *words: str | Path, folder: Path = ROOT, environment: Mapping[str, str] | None = None
) -> str:
    """Run a command and return what it prints; RuntimeError with its output if it fails."""
    done = subprocess.run(
        [str(word) for word in words],
        cwd=folder,
        env=environment,
        check=False,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    if done.returncode:
        raise RuntimeError(f"{' '.join(map(str, words))}\n{done.stdout[-2000:]}")
    return done.stdout


def interpreter(version: str) -> Path | None:
    """Return the interpreter of a version on this computer, if it has one."""
    on_path = shutil.which(f"python{version}")
    installed = sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python3"))
    for path in ([Path(on_path)] if on_path else []) + installed:
        shown = subprocess.run([path, "--version"], check=False, capture_output=True, text=True)
        if shown.returncode == 0 and shown.stdout.startswith(f"Python {version}."):
            return path
    return None


def check_wheel(platform: str, folder: Path) -> str:
    """Build the wheel of a platform; auditwheel has to agree with its name."""
    environment = {**os.environ, "DWELL_WHEEL_PLATFORM": platform}
    run(UV, "build", "--quiet", "--wheel", "--out-dir", folder, environment=environment)
    (wheel,) = folder.glob(f"*{platform}.whl")
    shown = " ".join(run(sys.executable, "-m", "auditwheel", "show", wheel).split())
    if f'platform tag: "{platform}"' not in shown:
        raise RuntimeError(shown)
    return f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB, as auditwheel says"


def check_python(version: str, folder: Path) -> str:
    """Install the wheel and the pins for a version, and simulate; else find all wheels."""
    found = interpreter(version)
    pins = ("--require-hashes", "--only-binary", ":all:", "-r", PINS)
    if found is None:
        target = ("--python-version", version, "--target", folder / version)
        looked_up = run(UV, "pip", "install", "--dry-run", *target, *pins)
        count = len(re.findall(r"^ \+ ", looked_up, re.MULTILINE))
        return f"Python {version}: not on this computer; wheels of all {count} packages exist"
    python = folder / version / "bin" / "python"
    run(UV, "venv", "--quiet", "--python", found, folder / version)
    (wheel,) = folder.glob(f"*{PLATFORMS[0]}.whl")
    run(UV, "pip", "install", "--quiet", "--python", python, *pins)
    run(UV, "pip", "install", "--quiet", "--python", python, "--no-deps", wheel)
    cell = run(python, "-c", "import dwell; print(dwell.__path__[0])").strip()
    example = Path(cell) / "examples" / "first.yaml"
    run(python, "-m", "dwell", "run", example, "--windows", "20", folder=folder / version)
    return f"{run(found, '--version').strip()}: installs the pins and the wheel, and simulates"


def lines_of(readme: str) -> list[str]:
    """Return the commands of a README that a stranger enters, in their order."""
    lines = [line for block in BLOCK.findall(readme) for line in block.splitlines()]
    commands = [
        line.removeprefix("$ ")
        for line in lines
        if line.startswith(("$ ", "make ", "dwell ", "uv "))
    ]
    return [command for command in commands if not command.startswith(LEFT_OUT)]


def check_gallery() -> str:
    """Make the pictures of the pages again; their data have to be the kept data."""
    run(sys.executable, "-m", "docs.gallery", "--check")
    return "the gallery has the data that the examples give"


def check_stranger(folder: Path) -> str:
    """Do what README says in a clone, with an empty home folder and no variables."""
    clone, home = folder / "clone", folder / "home"
    home.mkdir()
    run("git", "clone", "--quiet", ROOT, clone)
    commands = lines_of((clone / "README.md").read_text(encoding="utf-8"))
    script = "\n".join(f"{command} || exit 1" for command in commands)
    path = os.environ["PATH"].replace(f"{Path(sys.executable).parent}{os.pathsep}", "")
    kept = {name: value for name, value in os.environ.items() if REACHES_INDEX.match(name)}
    run("bash", "-c", script, folder=clone, environment={**kept, "PATH": path, "HOME": str(home)})
    return f"README in an empty home folder: {len(commands)} lines work"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a line per check; return 1 if one fails."""
    parser = argparse.ArgumentParser(prog="python -m tests.release_check", description=__doc__)
    parser.add_argument("--only", default="", help="checks whose name contains this")
    only = parser.parse_args(arguments).only
    failed = False
    with TemporaryDirectory() as name:
        folder = Path(name)
        checks: dict[str, tuple[Callable[..., str], tuple[object, ...]]] = {
            **{f"wheel {one}": (check_wheel, (one, folder)) for one in PLATFORMS},
            **{f"python {one}": (check_python, (one, folder)) for one in VERSIONS},
            "gallery": (check_gallery, ()),
            "stranger": (check_stranger, (folder,)),
        }
        for check, (does, given) in checks.items():
            if only not in check:
                continue
            try:
                print(f"passed  {does(*given)}", flush=True)
            except RuntimeError as error:
                failed = True
                print(f"failed  {check}: {error}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
