"""The build hook: which compiler it takes, what it builds, what it says where it cannot."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

import hatch_build
from dwell.kernels.library_file import read_header
from tests.kernels.compilers import COMPILERS, LIBRARY, needs_clang, needs_gcc

ROOT = Path(__file__).parents[1]
GXX = shutil.which("g++")
NEEDS_READELF = pytest.mark.skipif(not shutil.which("readelf"), reason="readelf is not installed")

# ----------------------------------------------------------------------- the compiler

Compilers = Callable[..., Path]


@pytest.fixture
def compilers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Compilers:
    """Return what makes a folder the only one with commands; none is there but those named."""
    folder = tmp_path / "bin"
    folder.mkdir()

    def made(**commands: str) -> Path:
        for name, line in commands.items():
            file = folder / name.replace("xx", "++")
            file.write_text(f'#!/bin/sh\nPATH={os.defpath}\n{line} "$@"\n', encoding="utf-8")
            file.chmod(0o755)
        monkeypatch.setenv("PATH", str(folder))
        return folder

    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(hatch_build, "ZIG", ("no-zig",))
    return made


OLD = "echo it knows no C++20 >&2; exit 1;"


def test_without_a_compiler_there_is_none(compilers: Compilers) -> None:
    compilers(gxx=OLD)
    assert hatch_build.find_compiler() == []


@needs_gcc
def test_the_first_compiler_that_knows_the_language_is_taken(compilers: Compilers) -> None:
    compilers(cxx=OLD, gxx=GXX or "", clangxx=GXX or "")
    assert hatch_build.find_compiler() == ["g++"]


@needs_gcc
def test_the_variable_names_the_compiler(
    compilers: Compilers, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = compilers(gxx=OLD, other=GXX or "")
    monkeypatch.setenv("CXX", f"{folder / 'other'} -DNAME='two words'")
    assert hatch_build.find_compiler() == [str(folder / "other"), "-DNAME=two words"]


@needs_gcc
def test_a_compiler_that_the_variable_names_and_that_fails_is_not_replaced_by_another(
    compilers: Compilers, monkeypatch: pytest.MonkeyPatch
) -> None:
    compilers(gxx=GXX or "")
    monkeypatch.setenv("CXX", "not-there")
    assert hatch_build.find_compiler() == []


@needs_clang
def test_ziglang_is_the_last(compilers: Compilers, monkeypatch: pytest.MonkeyPatch) -> None:
    compilers(gxx=OLD)
    monkeypatch.setattr(hatch_build, "ZIG", (sys.executable, "-m", "ziglang", "c++"))
    assert hatch_build.find_compiler() == COMPILERS["clang"]


# ----------------------------------------------------------------------- the library


@pytest.fixture
def sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with the least of the sources, which the hook builds from now on."""
    folder = tmp_path / "two words"
    folder.mkdir()
    for name in ("library.cpp", "export.h", "compile_flags.txt"):
        shutil.copy(hatch_build.KERNELS / name, folder)
    monkeypatch.setattr(hatch_build, "KERNELS", folder)
    return folder


def change(source: Path) -> None:
    with source.open("a", encoding="utf-8") as text:
        text.write("// changed\n")


@needs_gcc
def test_what_is_built_already_is_left(sources: Path) -> None:
    library = sources / LIBRARY
    hatch_build.build(["g++"], library)
    first = library.stat()
    hatch_build.build(["g++"], library)
    assert library.stat() == first
    change(sources / "export.h")
    hatch_build.build(["g++"], library)
    second = library.stat()
    assert second.st_ino != first.st_ino, "it was replaced, not written into"
    hatch_build.build(["g++"], library, ["-O0"])
    assert library.stat().st_ino != second.st_ino
    library.write_bytes(library.read_bytes()[:-1])
    hatch_build.build(["g++"], library, ["-O0"])
    header = read_header(library.read_bytes())
    assert header is not None
    assert header.n_bytes == library.stat().st_size


@needs_gcc
def test_a_fault_in_a_source_is_told_and_the_old_library_stays(sources: Path) -> None:
    library = sources / LIBRARY
    hatch_build.build(["g++"], library)
    before = library.read_bytes()
    (sources / "more.cpp").write_text("int broken = ;\n", encoding="utf-8")
    with pytest.raises(SystemExit, match=r"more\.cpp:1:14: error"):
        hatch_build.build(["g++"], library)
    assert library.read_bytes() == before
    assert {path.suffix for path in sources.iterdir()} == {".cpp", ".h", ".txt", ".so"}


@needs_gcc
def test_what_no_library_has_is_told(sources: Path) -> None:
    text = "void missing();\nvoid call() { missing(); }\n"
    (sources / "more.cpp").write_text(text, encoding="utf-8")
    with pytest.raises(SystemExit, match="undefined reference"):
        hatch_build.build(["g++"], sources / LIBRARY)


@needs_gcc
def test_a_place_that_cannot_be_written_is_told(sources: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    library = tmp_path / "file" / LIBRARY
    with pytest.raises(SystemExit, match=f"{library} cannot be written: "):
        hatch_build.build(["g++"], library)


# ----------------------------------------------------------------------- checkouts and wheels


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Return a folder that can be built, with the least of the sources."""
    folder = tmp_path / "checkout"
    kernels = folder / "src" / "dwell" / "kernels"
    left_out = shutil.ignore_patterns("__pycache__", "*.so", "*.cpp")
    shutil.copytree(ROOT / "src", folder / "src", ignore=left_out)
    shutil.copy(ROOT / "src" / "dwell" / "kernels" / "library.cpp", kernels)
    for name in ("pyproject.toml", "hatch_build.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    shutil.copytree(ROOT / "examples", folder / "examples")
    return folder


@pytest.fixture
def no_compiler(tmp_path: Path) -> dict[str, str]:
    """Return variables by which a build finds no compiler."""
    package = tmp_path / "none" / "ziglang"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "__main__.py").write_text("import sys; sys.exit(1)\n", encoding="utf-8")
    return {"CXX": "not-there", "PYTHONPATH": str(package.parent)}


def hatchling(checkout: Path, call: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Call the build as installers do."""
    return subprocess.run(
        [sys.executable, "-c", f"import hatchling.build\nprint(hatchling.build.{call})"],
        check=False,
        capture_output=True,
        text=True,
        cwd=checkout,
        env={**os.environ, **variables},
    )


@pytest.mark.parametrize("what", ["wheel", "editable"])
def test_an_isolated_build_asks_for_ziglang_where_there_is_no_compiler(
    what: str, checkout: Path, no_compiler: dict[str, str]
) -> None:
    call = f"get_requires_for_build_{what}()"
    assert "'ziglang" in hatchling(checkout, call, **no_compiler).stdout
    assert "'ziglang" not in hatchling(checkout, call).stdout


def test_a_source_distribution_needs_no_compiler(
    checkout: Path, no_compiler: dict[str, str]
) -> None:
    asked = hatchling(checkout, "get_requires_for_build_sdist()", **no_compiler)
    assert asked.stdout == "[]\n"
    done = hatchling(checkout, "build_sdist('dist')", **no_compiler)
    assert done.returncode == 0, done.stderr


def test_an_editable_install_without_a_compiler_goes_on_and_says_so(
    checkout: Path, no_compiler: dict[str, str]
) -> None:
    done = hatchling(checkout, "build_editable('dist')", **no_compiler)
    assert done.returncode == 0, done.stderr
    assert hatch_build.NO_KERNEL in done.stdout + done.stderr
    assert list((checkout / "dist").glob("*.whl"))
    assert not list(checkout.rglob("*.so"))


def test_make_says_so_too(no_compiler: dict[str, str]) -> None:
    """By this call; what installers run is not shown."""
    assert "$(BIN)/python hatch_build.py" in (ROOT / "Makefile").read_text(encoding="utf-8")
    done = subprocess.run(
        [sys.executable, ROOT / "hatch_build.py"],
        check=False,
        capture_output=True,
        text=True,
        env={**os.environ, **no_compiler},
    )
    assert (done.returncode, done.stderr) == (1, f"{hatch_build.NO_KERNEL}\n")


def test_a_wheel_without_a_compiler_fails_in_one_sentence(
    checkout: Path, no_compiler: dict[str, str]
) -> None:
    done = hatchling(checkout, "build_wheel('dist')", **no_compiler)
    assert (done.returncode, done.stderr) == (1, f"{hatch_build.NO_WHEEL}\n")


def test_an_editable_install_has_the_library_beside_its_sources(checkout: Path) -> None:
    done = hatchling(checkout, "build_editable('dist')")
    assert done.returncode == 0, done.stderr
    assert (checkout / "src" / "dwell" / "kernels" / LIBRARY).is_file()
    assert not (checkout / "build").exists()


def test_a_wheel_of_a_checkout_leaves_its_sources_as_they_are(checkout: Path) -> None:
    (checkout / ".gitignore").write_text("*.so\n", encoding="utf-8")
    ours = checkout / "src" / "dwell" / "kernels" / LIBRARY
    ours.write_bytes(b"of another build")
    done = hatchling(checkout, "build_wheel('dist')")
    assert done.returncode == 0, done.stderr
    (wheel,) = (checkout / "dist").glob("*.whl")
    assert re.fullmatch(r"dwell_placement-[\d.]+-py3-none-linux_\w+\.whl", wheel.name)
    with zipfile.ZipFile(wheel) as archive:
        made = archive.read(f"dwell/kernels/{LIBRARY}")
    assert read_header(made) is not None
    assert ours.read_bytes() == b"of another build"


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="no checkout of git")
@pytest.mark.parametrize("name", [LIBRARY, ".build-1234/library.o"])
def test_git_does_not_see_what_is_built(name: str) -> None:
    path = hatch_build.KERNELS / name
    assert (
        subprocess.run(["git", "check-ignore", "-q", path], cwd=ROOT, check=False).returncode == 0
    )


# ----------------------------------------------------------------------- wheels of a release

#: By the platform's name: the processor.
RELEASED = {"manylinux_2_17_x86_64": "x86_64", "manylinux_2_17_aarch64": "aarch64"}


@needs_clang
@NEEDS_READELF
@pytest.mark.parametrize("platform", RELEASED)
def test_a_wheel_of_a_release_needs_glibc_2_17_alone(platform: str, tmp_path: Path) -> None:
    command = f"DWELL_WHEEL_PLATFORM={platform} .venv/bin/uv build --wheel\n"
    assert command in (ROOT / "docs" / "howto" / "releasing.md").read_text(encoding="utf-8")
    done = hatchling(ROOT, f"build_wheel({str(tmp_path)!r})", DWELL_WHEEL_PLATFORM=platform)
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.name.endswith(f"-py3-none-{platform}.whl")
    shutil.unpack_archive(wheel, tmp_path, "zip")
    library = tmp_path / "dwell" / "kernels" / LIBRARY
    header = read_header(library.read_bytes())
    assert header is not None
    assert header.machine == RELEASED[platform]
    assert needed_libraries(library) <= {"libc.so.6", "libm.so.6"}
    assert max(glibc_versions(library), default=(2, 0)) <= (2, 17)


@NEEDS_READELF
def test_the_library_here_needs_libc_and_libm_alone() -> None:
    assert needed_libraries(hatch_build.KERNELS / LIBRARY) <= {"libc.so.6", "libm.so.6"}


@NEEDS_READELF
def test_the_library_shows_what_python_calls_and_no_more() -> None:
    shown = readelf("--dyn-syms", hatch_build.KERNELS / LIBRARY)
    names = re.findall(r"(?:GLOBAL|WEAK)\s+DEFAULT\s+\d+ (\S+)", shown)
    assert names
    assert [name for name in names if not name.startswith("dwell_")] == []


def readelf(option: str, library: Path) -> str:
    words = ["readelf", "--wide", option, str(library)]
    return subprocess.run(words, check=True, capture_output=True, text=True).stdout


def needed_libraries(library: Path) -> set[str]:
    return set(re.findall(r"\(NEEDED\).*\[(.*)\]", readelf("--dynamic", library)))


def glibc_versions(library: Path) -> list[tuple[int, ...]]:
    """Return the versions of glibc's symbols, as numbers."""
    found = re.findall(r"Name: GLIBC_([\d.]+)", readelf("--version-info", library))
    return [tuple(map(int, version.split("."))) for version in found]
