"""The order of training: a pure function of seed and step."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch.utils.data import Dataset
from torch.utils.data.distributed import DistributedSampler


class StepSampler(DistributedSampler[int]):
    """Draws the items of every global step from (seed, step) alone.

    An epoch is ``steps`` batches. Draws run through shuffled passes over all items, each item once
    per pass, across epoch borders; so a resumed run sees the order of an unbroken one. It is a
    `DistributedSampler` because Lightning would wrap and reshuffle anything else on several
    processes; the processes share the draws of a step between them.

    Args:
        items: number of items.
        batch_size: items per batch and process.
        steps: batches per epoch.
        seed: of the shuffles.
        replicas: number of processes.
        rank: of this process.
    """

    def __init__(
        self, items: int, batch_size: int, steps: int, seed: int, replicas: int = 1, rank: int = 0
    ) -> None:
        super().__init__(_Count(items), num_replicas=replicas, rank=rank, shuffle=True, seed=seed)
        self.items, self.batch_size, self.steps = items, batch_size, steps

    def __len__(self) -> int:
        return self.steps * self.batch_size

    def __iter__(self) -> Iterator[int]:
        order, shuffled = torch.empty(0), -1
        for step in range(self.epoch * self.steps, (self.epoch + 1) * self.steps):
            first = (step * self.num_replicas + self.rank) * self.batch_size
            for draw in range(first, first + self.batch_size):
                if draw // self.items != shuffled:
                    shuffled = draw // self.items
                    order = pass_order(self.items, self.seed, shuffled)
                yield int(order[draw % self.items])


class _Count(Dataset[int]):
    """A length; `DistributedSampler` asks its dataset for nothing else."""

    def __init__(self, length: int) -> None:
        self.length = length

    def __len__(self) -> int:
        return self.length


def pass_order(items: int, seed: int, number: int) -> torch.Tensor:
    """``[items]`` the order of a shuffled pass, a pure function of its arguments."""
    mixed = np.random.SeedSequence([seed, number]).generate_state(1, np.uint64)[0]
    generator = torch.Generator().manual_seed(int(mixed) >> 1)
    return torch.randperm(items, generator=generator)
