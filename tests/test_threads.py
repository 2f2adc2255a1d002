"""Several threads for one computation."""

import os
import threading
import time

import jax
import pytest

from sidestep._threads import allowed_threads, side_by_side, useful_threads


def counted(count, names, pause=0.0):
    for number in range(count):
        names.add(threading.current_thread().name)
        time.sleep(pause)
        yield number


def test_each_iterable_has_a_thread_and_everything_is_told_here():
    names, told, here = set(), [], threading.current_thread()

    def tell(number):
        assert threading.current_thread() is here
        told.append(number)

    side_by_side([counted(20, names, 0.001), counted(30, names, 0.001)], tell)
    assert sorted(told) == sorted([*range(20), *range(30)])
    assert len(names) == 2
    assert here.name not in names


def test_a_single_one_needs_no_other_thread():
    names = set()
    side_by_side([counted(3, names)], lambda _: None)
    assert names == {threading.current_thread().name}


def test_an_error_in_one_thread_ends_the_others_and_comes_out():
    seen = []

    def failing():
        yield 0
        raise ZeroDivisionError("in a thread")

    def endless():
        while True:
            seen.append(1)
            time.sleep(0.001)
            yield 0

    with pytest.raises(ZeroDivisionError, match="in a thread"):
        side_by_side([endless(), failing()], lambda _: None)
    ended = len(seen)
    time.sleep(0.02)
    assert len(seen) == ended


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt])
def test_an_error_here_ends_all_threads(error):
    seen = []

    def endless():
        while True:
            seen.append(1)
            time.sleep(0.001)
            yield 0

    def tell(_):
        if len(seen) > 5:
            raise error

    with pytest.raises(error):
        side_by_side([endless(), endless()], tell)
    ended = len(seen)
    time.sleep(0.02)
    assert len(seen) == ended


def test_no_more_threads_than_xla_may_have(monkeypatch):
    monkeypatch.setenv("PJRT_NPROC", "1")
    assert allowed_threads() == 1
    assert useful_threads(100) == 1
    monkeypatch.delenv("PJRT_NPROC")
    assert 1 <= allowed_threads() <= (os.cpu_count() or 1)
    assert useful_threads(1) == 1
    assert useful_threads(100) == allowed_threads()


def test_settings_of_one_thread_keep_the_work_in_it():
    with jax.enable_x64(not jax.config.jax_enable_x64):
        assert useful_threads(100) == 1
    with jax.disable_jit():
        assert useful_threads(100) == 1
