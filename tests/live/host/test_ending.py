"""Signals that end a process: in order, and at once."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

#: Says that it waits, then that it ends in order; a second signal keeps it from that.
PROGRAM = """
import os, signal, sys, threading
from dwell.live.host.ending import end_when_told
if "nohup" in sys.argv:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
stopped = threading.Event()
again = (lambda: print("again", flush=True)) if "again" in sys.argv else None
end_when_told(stopped, lambda: os._exit(9), again)
print("waits", flush=True)
while not stopped.wait(0.1):  # Python handles a signal that comes just before a wait after it.
    pass
print("ends", flush=True)
sys.stdin.readline()
print("has ended", flush=True)
"""


#: Ends many times, each time by a signal that comes while the event is looked at.
IMPATIENT = """
import os, signal, threading
from dwell.live.host.ending import end_when_told
for i in range(2000):
    stopped = threading.Event()
    end_when_told(stopped, lambda: os._exit(9))
    signal.signal(signal.SIGALRM, signal.getsignal(signal.SIGTERM))
    signal.setitimer(signal.ITIMER_REAL, 1e-4 + i * 1e-7)
    while not stopped.wait(0):
        pass
"""


def start(*words: str, leads: bool = False) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *words],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=leads,
    )
    assert said(process) == "waits"
    return process


def said(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_the_first_signal_ends_it_in_order(number: int) -> None:
    with start() as process:
        process.send_signal(number)
        assert said(process) == "ends"
        # Another one of these is no second signal.
        process.send_signal(signal.SIGHUP)
        assert process.communicate("\n", timeout=20)[0] == "has ended\n"
        assert process.returncode == 0


def test_a_signal_that_comes_while_the_event_is_looked_at_ends_it() -> None:
    subprocess.run([sys.executable, "-c", IMPATIENT], check=True, timeout=60)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_the_second_signal_ends_it_at_once(number: int) -> None:
    with start() as process:
        process.send_signal(signal.SIGTERM)
        assert said(process) == "ends"
        process.send_signal(number)
        assert process.wait(20) == 9


def test_who_shall_outlive_its_terminal_does() -> None:
    with start("nohup") as process:
        process.send_signal(signal.SIGHUP)
        process.send_signal(signal.SIGTERM)
        assert said(process) == "ends"
        process.kill()


#: Ends helpers of a stage that is itself ended by the signals of this process.
HELPERS = """
import concurrent.futures, multiprocessing, os, signal, threading, time
from dwell.live.host.ending import end_when_told

def nap():
    for _ in range(1000):  # Python handles a signal that comes just before a sleep after it.
        time.sleep(0.1)

def fail():
    raise ValueError

def pool():
    with multiprocessing.Pool(2) as helpers:
        helpers.apply_async(nap)

def broken_executor():
    with concurrent.futures.ProcessPoolExecutor(2, fork) as helpers:
        helpers.submit(nap)
        helpers.submit(os._exit, 1)

def joblib_pool():
    from joblib import Parallel, delayed
    try:
        Parallel(2, backend="multiprocessing")([delayed(nap)(), delayed(fail)()])
    except ValueError:
        pass

def at_once():
    for number in (signal.SIGTERM, signal.SIGHUP) * 100:
        helper = fork.Process(target=nap)
        helper.start()
        os.kill(helper.pid, number)
        helper.join()
        assert helper.exitcode == -number

def in_a_thread():
    thread = threading.Thread(target=at_once)
    thread.start()
    thread.join()

def begin(begun):
    begun.set()
    nap()

def interrupted():
    begun = fork.Event()
    helper = fork.Process(target=begin, args=(begun,))
    helper.start()
    begun.wait()
    os.kill(helper.pid, signal.SIGINT)
    helper.join()
    assert helper.exitcode == 1  # of a KeyboardInterrupt

def own_handler():
    signal.signal(signal.SIGTERM, lambda *_: os._exit(7))
    helper = fork.Process(target=nap)
    helper.start()
    helper.terminate()
    helper.join()
    assert helper.exitcode == 7

fork = multiprocessing.get_context("fork")
stopped = threading.Event()
end_when_told(stopped, lambda: os._exit(9))
CALL()
assert not signal.pthread_sigmask(signal.SIG_BLOCK, [])
os.kill(os.getpid(), signal.SIGHUP)
assert stopped.wait(20)
"""


@pytest.mark.parametrize(
    "how",
    [
        "pool",
        "broken_executor",
        "joblib_pool",
        "at_once",
        "in_a_thread",
        "interrupted",
        "own_handler",
    ],
)
def test_helpers_of_a_stage_can_be_ended_by_signals(how: str) -> None:
    program = HELPERS.replace("CALL", how)
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)


@pytest.mark.parametrize("words", [("again",), ("again", "nohup")])
def test_a_hangup_has_a_service_take_files_over(words: tuple[str, ...]) -> None:
    with start(*words, leads=True) as process:
        for _ in range(2):
            process.send_signal(signal.SIGHUP)
            assert said(process) == "again"
        process.send_signal(signal.SIGTERM)
        assert said(process) == "ends"


def test_a_hangup_ends_a_process_of_a_terminal() -> None:
    with start("again") as process:
        process.send_signal(signal.SIGHUP)
        assert said(process) == "ends"
