"""Work on several views or pairs at once, one on each core."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, TypeVar

import torch

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    Item = TypeVar("Item")
    Result = TypeVar("Result")

_STARTING = threading.Lock()
START_TIMEOUT = 60.0
"""Seconds in which threads must have started."""


def side_by_side(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """What a function gives for each item, in their order, on as many threads as torch has.

    Each has one thread of torch's to itself, also where there is one item alone: a result must not depend on
    how many were asked for together, and torch may round differently on another number of threads.

    While the threads start, torch's number of threads is one for the whole process: a thread that uses torch
    for the first time in that moment, other than through here, is left with one.

    Args:
        function: called from other threads, several at a time. Switches of torch's that belong to a thread,
            such as `torch.no_grad`, are as in any new thread.
        items: what it is called with.
    """
    waiting = list(items)
    if not waiting:
        return []
    # Not while others start theirs: a thread takes over the process's number when it first asks for it.
    with _STARTING:
        threads = torch.get_num_threads()
    count = min(threads, len(waiting))
    started = threading.Barrier(count + 1, timeout=START_TIMEOUT)

    def alone() -> None:
        torch.get_num_threads()  # takes that number over now, so that it cannot come later
        torch.set_num_threads(1)
        started.wait()

    with ThreadPoolExecutor(count, initializer=alone) as pool:
        with _STARTING:
            try:
                results = pool.map(function, waiting)  # none is idle before all have started: so many start
                started.wait()
            finally:
                torch.set_num_threads(threads)
        return list(results)
