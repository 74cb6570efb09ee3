import os
import sys

import pytest

from app.jobs.process import in_own_process

ALL = len(os.sched_getaffinity(0)) if sys.platform == "linux" else 0


def affinities(threads: int | None) -> list[frozenset[int]]:
    """Processors that each thread of a process may use after Taichi has started."""
    from taichi_sph import start

    start("cpu", threads=threads)
    return [frozenset(os.sched_getaffinity(int(t))) for t in os.listdir("/proc/self/task")]


@pytest.mark.skipif(ALL < 2, reason="needs Linux and two processors")
def test_each_processor_has_a_thread_of_its_own_when_all_are_used():
    found = in_own_process(affinities, None)
    own = [next(iter(mask)) for mask in found if len(mask) == 1]
    assert sorted(own) == sorted(os.sched_getaffinity(0))


@pytest.mark.skipif(ALL < 2, reason="needs Linux and two processors")
def test_programs_with_fewer_threads_do_not_share_the_first_processor():
    assert all(len(mask) == ALL for mask in in_own_process(affinities, ALL - 1))
