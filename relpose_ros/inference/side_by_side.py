"""Work on several views or pairs at once, one on each core."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, TypeVar

import torch

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    Item = TypeVar("Item")
    Result = TypeVar("Result")


def side_by_side(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """What a function gives for each item, in their order, on as many threads as torch has.

    Each has one thread of torch's to itself, also where there is one item alone: a result must not depend on
    how many were asked for together, and torch may round differently on another number of threads.

    Args:
        function: called from other threads, several at a time. Switches of torch's that belong to a thread,
            such as `torch.no_grad`, are as in any new thread.
        items: what it is called with.
    """
    threads = torch.get_num_threads()
    try:
        with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            return list(pool.map(function, items))
    finally:
        # What a thread asks for is also what threads yet to be started get: once the pool's have all ended.
        torch.set_num_threads(threads)
