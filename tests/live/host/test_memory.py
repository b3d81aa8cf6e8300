"""A process that keeps its memory has no page faults for arrays that come and go."""

import platform
import subprocess
import sys

import pytest

# Eight pictures that come and go together are more than the heap's end may hold by itself.
LOOP = """
import resource, sys
import numpy as np
from dwell.live.host.memory import keep_memory

if sys.argv[1] == "keep":
    assert keep_memory()

def job():
    work = [np.ones(size, np.uint8) for size in 8 * [307_200]]
    return sum(int(one[-1]) for one in work)

def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

for _ in range(20):
    job()
before = faults()
for _ in range(100):
    job()
print((faults() - before) / 100)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="asks the GNU C library")
def test_arrays_that_come_and_go_are_no_page_faults_where_memory_is_kept() -> None:
    faults = {
        how: float(
            subprocess.run(
                [sys.executable, "-c", LOOP, how], capture_output=True, text=True, check=True
            ).stdout
        )
        for how in ("keep", "give back")
    }
    assert faults["keep"] < 1
    assert faults["give back"] > 100, "nothing is given back here: the test shows nothing"
