"""The loader of the compiled kernel: what it opens, and what it refuses by name."""

from __future__ import annotations

import ctypes
import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from dwell.errors import KernelError
from dwell.kernels import servo_loop
from dwell.kernels.library import compiler, digest, library, load
from dwell.kernels.library_file import MACHINES, NAME, source_digest
from dwell.model import MovingTarget, Servo

KERNELS = Path(str(files("dwell.kernels")))
ROOT = Path(__file__).parents[2]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a copy of the folder of kernels, as an installed package has it."""
    return Path(shutil.copytree(KERNELS, tmp_path / "kernels"))


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Return a copy of the folder of kernels, as a checkout has it."""
    shutil.copy(ROOT / "hatch_build.py", tmp_path)
    return Path(shutil.copytree(KERNELS, tmp_path / "src" / "dwell" / "kernels"))


def refusal(folder: Path) -> str:
    """Return why the library in a folder is refused: one line, without its name."""
    with pytest.raises(KernelError) as caught:
        load(folder)
    start = f"the compiled kernel {folder / NAME} "
    message = str(caught.value)
    assert message.startswith(start)
    assert "\n" not in message
    return message.removeprefix(start)


def test_the_library_is_that_of_the_sources_and_loaded_once() -> None:
    assert library() is library()
    assert digest() == source_digest(KERNELS)
    assert compiler()


def test_a_missing_library_is_refused(folder: Path, checkout: Path) -> None:
    (folder / NAME).unlink()
    (checkout / NAME).unlink()
    assert refusal(folder) == "is missing; pip install --force-reinstall dwell-placement"
    assert refusal(checkout) == "is missing; apt-get install g++ && make env"


@pytest.mark.parametrize("share", [0.0, 0.0003, 0.3, 0.6, 0.9, 0.999])
def test_a_library_that_is_cut_short_is_refused(share: float, folder: Path) -> None:
    """Opened, it would end this process where it reads what is not there."""
    content = (folder / NAME).read_bytes()
    (folder / NAME).write_bytes(content[: int(share * len(content))])
    flaw = "is no library" if int(share * len(content)) < 64 else "is cut short: "
    assert refusal(folder).startswith(flaw)


def test_a_file_that_is_no_library_is_refused(folder: Path) -> None:
    (folder / NAME).write_text("no library\n" * 1000, encoding="utf-8")
    assert refusal(folder).startswith("is no library; ")


def test_a_folder_in_the_place_of_the_library_is_refused(folder: Path) -> None:
    (folder / NAME).unlink()
    (folder / NAME).mkdir()
    assert refusal(folder).startswith("cannot be opened: Is a directory; ")


@pytest.mark.parametrize("name", ["library.cpp", "export.h", "compile_flags.txt", "more.cpp"])
def test_a_library_of_other_sources_is_refused(name: str, folder: Path) -> None:
    with (folder / name).open("a", encoding="utf-8") as source:
        source.write("\n")
    assert refusal(folder).startswith("was built of other sources than those beside it; ")


def test_a_wheel_has_no_sources(folder: Path) -> None:
    for source in (*folder.glob("*.cpp"), *folder.glob("*.h"), *folder.glob("*.txt")):
        source.unlink()
    assert load(folder).dwell_digest is not None


def test_a_library_of_a_source_that_is_gone_is_refused(checkout: Path) -> None:
    (checkout / "export.h").unlink()
    mends = f"rm {checkout / NAME} && make env"
    assert refusal(checkout) == f"was built of other sources than those beside it; {mends}"


def test_a_library_for_another_processor_is_refused(folder: Path) -> None:
    content = bytearray((folder / NAME).read_bytes())
    here = int.from_bytes(content[18:20], "little")
    other = next(number for number in MACHINES if number != here)
    content[18:20] = other.to_bytes(2, "little")
    (folder / NAME).write_bytes(content)
    flaw = f"is for {MACHINES[other]}, this computer is {MACHINES[here]}; "
    assert refusal(folder).startswith(flaw)


def test_a_library_that_the_system_cannot_open_is_refused(folder: Path) -> None:
    """Its table of segments is gone, its head and its length are well."""
    content = bytearray((folder / NAME).read_bytes())
    content[64 : 64 + 56 * 3] = bytes(56 * 3)
    content[54:58] = bytes(4)
    (folder / NAME).write_bytes(content)
    assert refusal(folder).startswith("cannot be opened: ")


def test_a_folder_may_have_spaces_and_be_read_only(folder: Path) -> None:
    spaced = folder.rename(folder.with_name("two words é"))
    spaced.chmod(0o555)
    try:
        assert load(spaced).dwell_digest is not None
    finally:
        spaced.chmod(0o755)


def test_the_line_that_mends_is_one_for_a_shell(checkout: Path) -> None:
    spaced = checkout.parents[2].rename(checkout.parents[2].with_name("two words"))
    kernels = spaced / "src" / "dwell" / "kernels"
    (kernels / NAME).write_bytes(b"")
    assert refusal(kernels) == f"is no library; rm '{kernels / NAME}' && make env"


# ----------------------------------------------------------------------- threads and processes


def test_threads_that_load_it_at_once_share_it(folder: Path) -> None:
    with ThreadPoolExecutor(8) as threads:
        loaded = list(threads.map(load, [folder] * 8))
    assert len({one._handle for one in loaded}) == 1


class Loop:
    """A long servo loop, whose result is known."""

    def __init__(self, n: int) -> None:
        released = 0.03 * np.arange(n, dtype=np.float64)
        self.instants = released, released + 0.035
        self.end = 0.03 * n
        self.expected = self.play()

    def play(self) -> bytes:
        servo = Servo("double-integrator", 30.0, MovingTarget(40.0, 1.6), damping=8.0)
        _, integrals, states = servo_loop.follow(servo, *self.instants, 0.0, self.end)
        return states.tobytes() + integrals.tobytes()


def test_two_threads_call_it_at_once() -> None:
    loop = Loop(300_000)
    with ThreadPoolExecutor(2) as threads:
        calls = [threads.submit(loop.play) for _ in range(2)]
    assert [call.result() == loop.expected for call in calls] == [True, True]


def test_python_s_lock_is_not_held_during_a_call() -> None:
    assert not isinstance(library(), ctypes.PyDLL)


def test_a_process_that_forks_during_a_call_has_two_that_can_call() -> None:
    long, short = Loop(300_000), Loop(1000)
    with ThreadPoolExecutor(1) as threads:
        call = threads.submit(long.play)
        forked = 0
        while not forked or not call.done():
            child = os.fork()
            if not child:
                os._exit(short.play() != short.expected)
            assert os.waitpid(child, 0) == (child, 0)
            forked += 1
    assert call.result() == long.expected
