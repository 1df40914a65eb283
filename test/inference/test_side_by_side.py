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
