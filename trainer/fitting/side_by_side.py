"""Predictions side by side: of small pictures each core makes its own, of large ones all cores make one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

from trainer.device import one_thread

# Up to so many pixels, threads that share a picture wait for each other longer than they work.
SMALL_PX = 640 * 480

X = TypeVar("X")
Y = TypeVar("Y")


def side_by_side(function: Callable[[X], Y], items: Sequence[X], pixels: int) -> list[Y]:
    """What a function gives for each item, in their order; at the same time, on this process's threads.

    One after the other where torch has one thread, as in a worker; where pictures are large; where derivatives are
    kept; on a GPU.

    Parameters
    ----------
    pixels : int
        Of one picture.
    """
    threads = torch.get_num_threads()
    alone = min(threads, len(items)) < 2 or pixels > SMALL_PX
    if alone or torch.is_grad_enabled() or torch.get_default_device().type != "cpu":
        return [function(item) for item in items]

    @torch.no_grad()  # which is a thread's own
    def made(item: X) -> Y:
        return function(item)

    with one_thread(), ThreadPoolExecutor(min(threads, len(items))) as pool:
        try:
            return list(pool.map(made, items))
        finally:
            pool.shutdown(cancel_futures=True)
