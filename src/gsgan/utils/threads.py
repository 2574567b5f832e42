"""A function of several values at the same time."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

Value = TypeVar("Value")
Result = TypeVar("Result")


def map_threads(
    function: Callable[[Value], Result], values: Iterable[Value]
) -> list[Result]:
    """The function's result for each value, in their order.

    As many are computed at a time as torch has threads, on one thread each: where only some of a
    function's operations use several threads, this is faster than one value after the other.
    """
    # Threads that start now take torch's present number.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(function, values))
    finally:
        torch.set_num_threads(threads)
