"""Threads that stay: what leaving a ``with`` waits for, and no growth of OpenCV's memory."""

import ctypes
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from gftorf_warp.data.threads import KeptThreads


def test_the_threads_of_a_name_are_those_of_the_last_time():
    """Two uses of one thread each; another name has another thread."""

    def thread(name):
        with KeptThreads(name, 1) as threads:
            return threads.submit(threading.get_ident).result()

    assert thread("test-a") == thread("test-a")
    assert thread("test-a") != thread("test-b")


def test_results_are_in_order_and_an_error_is_raised():
    """As by any executor, by as many threads as are given."""
    with KeptThreads("test-order", 3) as threads:
        assert list(threads.map(divmod, [7, 8, 9], [4, 4, 4])) == [(1, 3), (2, 0), (2, 1)]
        with pytest.raises(ZeroDivisionError):
            list(threads.map(divmod, [1, 1], [1, 0]))


def test_leaving_waits_for_what_was_submitted():
    """Also when an exception leaves it: nobody's work goes on behind its back."""
    done = []

    def slow(n):
        time.sleep(0.02)
        done.append(n)

    def left_by_an_exception():
        with KeptThreads("test-wait", 2) as threads:
            for n in range(5):
                threads.submit(slow, n)
            raise RuntimeError

    with pytest.raises(RuntimeError):
        left_by_an_exception()
    assert sorted(done) == [0, 1, 2, 3, 4]


def test_cancelled_work_does_not_begin_and_others_are_left_alone():
    """What another one submitted to the same thread is done all the same."""
    go, done = threading.Event(), []
    first, second = KeptThreads("test-cancel", 1), KeptThreads("test-cancel", 1)
    first.submit(go.wait)
    first.submit(done.append, "first")
    kept = second.submit(done.append, "second")
    first.shutdown(wait=False, cancel_futures=True)
    go.set()
    kept.result()
    assert done == ["second"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
def test_a_fork_has_threads_of_its_own():
    """Those of its parent do not exist in it."""
    with KeptThreads("test-fork", 1) as threads:
        threads.submit(int).result()
    if (child := os.fork()) == 0:
        with KeptThreads("test-fork", 1) as threads:
            os._exit(threads.submit(int, "3").result())
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 3


GROWTH = """
import ctypes, gc
from ftorf_folder import scene
from gftorf_warp.data.flow import compute_flow

class Usage(ctypes.Structure):
    _fields_ = [(f"n{i}", ctypes.c_size_t) for i in range(10)]

usage = ctypes.CDLL(None).mallinfo2
usage.restype = Usage
sequence, _ = scene(8, 16, 24)
now = 0
for calls in (20, 60):
    for _ in range(calls):
        compute_flow(sequence)
    gc.collect()
    before, now = now, usage().n7  # uordblks
print((now - before) / calls)
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="no glibc 2.33")
def test_optical_flow_does_not_grow_the_heap():
    """Bytes that the C library has handed out, per call; 2,300 when every call had new threads.
    Without the caches of its threads, which fill up over many calls.
    """
    environment = os.environ | {"GLIBC_TUNABLES": "glibc.malloc.tcache_count=0"}
    command, here = [sys.executable, "-c", GROWTH], Path(__file__).parent
    assert float(subprocess.check_output(command, env=environment, cwd=here)) < 500
