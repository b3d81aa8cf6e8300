"""Builds the compiled kernel with the package: src/dwell/kernels/*.cpp, as one library.

An editable install has the library next to its sources, a wheel gets it from `build/`. The compiler
is $CXX, else the first system compiler that knows C++20, else the package `ziglang`, which isolated
builds then require. With DWELL_WHEEL_PLATFORM=manylinux_2_17_aarch64 ziglang builds a wheel for
that platform (docs/howto/releasing.md).
"""

from __future__ import annotations

import os
import re
import runpy
import shlex
import subprocess
import sys
import sysconfig
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

KERNELS = Path(__file__).resolve().parent / "src" / "dwell" / "kernels"
FILE = runpy.run_path(str(KERNELS / "library_file.py"))

ZIG = (sys.executable, "-m", "ziglang", "c++")
#: Unused libraries, such as the standard library of C++, are not needed at run time.
LINK = ("-shared", "-static-libgcc", "-Wl,--as-needed", "-Wl,-z,defs", "-Wl,-s")
PROBE = "#include <bit>\n#include <concepts>\nstatic_assert(std::integral<int>);\n"

NO_COMPILER = "no C++20 compiler was found"
NO_KERNEL = (
    f"{NO_COMPILER}: Dwell cannot simulate without its kernel; apt-get install g++ && make env"
)
NO_WHEEL = f"{NO_COMPILER}: a wheel cannot be built without its kernel; apt-get install g++"


class KernelHook(BuildHookInterface):  # type: ignore[type-arg]
    """Builds the library before a wheel or an editable install."""

    def dependencies(self) -> list[str]:
        """Require ziglang if there is no other compiler."""
        return [] if find_compiler() else list(self.metadata.config["dependency-groups"]["zig"])

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the library; without a compiler a wheel fails, an editable install goes on."""
        compiler = find_compiler()
        if version == "editable":
            if compiler:
                build(compiler, KERNELS / FILE["NAME"])
            else:
                self.app.display_warning(NO_KERNEL)
            return
        if not compiler:
            raise SystemExit(NO_WHEEL)
        platform = os.environ.get("DWELL_WHEEL_PLATFORM") or sysconfig.get_platform()
        tag = re.sub(r"[-.]", "_", platform)
        library = Path(self.root, "build", tag, FILE["NAME"])
        build(compiler, library)
        build_data["force_include"][str(library)] = f"dwell/kernels/{library.name}"
        build_data.update(pure_python=False, tag=f"py3-none-{tag}")


def find_compiler() -> list[str]:
    """Return the command of the first compiler that makes a C++20 library; empty without one."""
    if platform := os.environ.get("DWELL_WHEEL_PLATFORM"):
        _, major, minor, machine = platform.split("_", 3)
        commands = [[*ZIG, "-target", f"{machine}-linux-gnu.{major}.{minor}"]]
    else:
        named = shlex.split(os.environ.get("CXX", ""))
        system = [named] if named else [["c++"], ["g++"], ["clang++"]]
        commands = [*system, [*ZIG, "-mcpu=baseline"]]
    with TemporaryDirectory() as folder:
        probe = Path(folder, "probe.cpp")
        probe.write_text(PROBE, encoding="utf-8")
        for command in commands:
            if not compile_library(command, [probe], ["-std=c++20"], Path(folder, "probe.so")):
                return command
    return []


def build(compiler: Sequence[str], library: Path, options: Sequence[str] = ()) -> None:
    """Compile the kernel, unless the same library exists.

    Parameters
    ----------
    compiler : sequence of str
        Command of the compiler.
    library : Path
        File of the library; an old one is replaced at the end.
    options : sequence of str
        Further options of the compiler.
    """
    version = subprocess.run([*compiler, "--version"], check=True, capture_output=True, text=True)
    name = " ".join([version.stdout.splitlines()[0], *options])
    digest = FILE["source_digest"](KERNELS)
    if library.is_file() and FILE["is_of"](library.read_bytes(), digest, name):
        return
    flags = (KERNELS / FILE["FLAGS"]).read_text(encoding="utf-8").split()
    flags += [*options, f'-DDWELL_DIGEST="{digest}"', f'-DDWELL_COMPILER="{name}"']
    try:
        library.parent.mkdir(parents=True, exist_ok=True)
        errors = compile_library(compiler, sorted(KERNELS.glob("*.cpp")), flags, library)
    except OSError as error:
        errors = f"{library} cannot be written: {error.strerror}"
    if errors:
        raise SystemExit(errors)


def compile_library(
    compiler: Sequence[str], sources: Iterable[Path], flags: Sequence[str], library: Path
) -> str:
    """Compile and link sources; return the errors of the compiler."""
    # If the link names the standard library of C++, Zig builds it first, for half a minute.
    link = [*LINK, "-nostdlib++"] if "ziglang" in compiler else LINK
    with TemporaryDirectory(dir=library.parent, prefix=".build-") as folder:
        objects = {source: Path(folder, f"{source.stem}.o") for source in sources}
        commands = [[*compiler, *flags, "-c", s, "-o", o] for s, o in objects.items()]
        with ThreadPoolExecutor(os.cpu_count()) as threads:
            errors = "".join(threads.map(_errors, commands))
        made = Path(folder, library.name)
        errors = errors or _errors([*compiler, *flags, *link, *objects.values(), "-o", made])
        if not errors:
            made.replace(library)
    return errors


def _errors(command: Sequence[str | Path]) -> str:
    """Run a compiler; return what it says where it fails."""
    try:
        done = subprocess.run(command, check=False, capture_output=True, text=True)
    except OSError as error:
        return str(error)
    return done.stderr or f"{command[0]} failed" if done.returncode else ""


if __name__ == "__main__":
    sys.exit(None if find_compiler() else NO_KERNEL)
