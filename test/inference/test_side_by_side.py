from __future__ import annotations

import threading
import time

import pytest
import torch

from relpose_ros.inference.side_by_side import side_by_side


@pytest.fixture(autouse=True)
def _three_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


def test_results_are_in_the_order_of_the_items():
    def slow_first(item: int) -> int:
        time.sleep(0.05 if item == 0 else 0)
        return 10 * item

    assert side_by_side(slow_first, range(5)) == [0, 10, 20, 30, 40]
    assert side_by_side(slow_first, []) == []


def test_as_many_at_once_as_torch_has_threads():
    together = threading.Barrier(3, timeout=20)
    assert sorted(side_by_side(lambda _: together.wait(), range(3))) == [0, 1, 2]


def test_each_has_one_thread_of_torch_and_the_rest_keeps_its_own():
    assert side_by_side(lambda _: torch.get_num_threads(), range(4)) == [1] * 4
    assert side_by_side(lambda _: torch.get_num_threads(), range(1)) == [1]
    in_new_thread = []
    thread = threading.Thread(target=lambda: in_new_thread.append(torch.get_num_threads()))
    thread.start()
    thread.join()
    assert [torch.get_num_threads(), *in_new_thread] == [3, 3]


def test_what_goes_wrong_is_told_and_leaves_the_threads_as_they_were():
    def fail(item: int) -> None:
        raise ValueError(f"not {item}")

    with pytest.raises(ValueError, match="not 0"):
        side_by_side(fail, range(3))
    assert torch.get_num_threads() == 3


def test_calls_that_overlap_keep_to_one_thread_each():
    """Torch tells a thread its number when that first asks: here only once another call has come and gone."""
    running, may_ask = threading.Event(), threading.Event()

    def ask_late(_: int) -> int:
        running.set()
        assert may_ask.wait(20)
        return torch.get_num_threads()

    found = []
    first = threading.Thread(target=lambda: found.extend(side_by_side(ask_late, range(2))))
    first.start()
    assert running.wait(20)
    assert side_by_side(lambda _: torch.get_num_threads(), range(3)) == [1] * 3
    may_ask.set()
    first.join(20)
    assert found == [1, 1]


def test_a_new_thread_that_calls_while_others_work_keeps_its_number():
    running, done = threading.Event(), threading.Event()

    def work(_: int) -> None:
        running.set()
        assert done.wait(20)

    first = threading.Thread(target=lambda: side_by_side(work, range(2)))
    first.start()
    assert running.wait(20)
    numbers = []

    def call() -> None:
        side_by_side(lambda item: item, range(2))
        numbers.append(torch.get_num_threads())

    for _ in range(2):
        caller = threading.Thread(target=call)
        caller.start()
        caller.join(20)
    done.set()
    first.join(20)
    assert [*numbers, torch.get_num_threads()] == [3, 3, 3]
