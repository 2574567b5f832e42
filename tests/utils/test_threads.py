"""A function of several values on several threads."""

import threading

import pytest
import torch

from gsgan.utils.threads import map_threads


def test_results_come_in_the_order_of_the_values():
    assert map_threads(lambda x: 2 * x, [3, 1, 2]) == [6, 2, 4]


def test_values_are_computed_at_the_same_time_on_one_thread_each():
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    together = threading.Barrier(2, timeout=30)

    def count(_: int) -> int:
        together.wait()
        return torch.get_num_threads()

    try:
        assert map_threads(count, range(2)) == [1, 1]
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)


def test_an_error_of_a_value_is_raised_and_the_number_of_threads_comes_back():
    threads = torch.get_num_threads()
    with pytest.raises(ZeroDivisionError):
        map_threads(lambda x: 1 / x, [1, 0])
    assert torch.get_num_threads() == threads
