"""Frozen dataclasses of tensors that move between devices and stack together."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

S = TypeVar("S", bound="TensorRecord")


@dataclass(frozen=True)
class TensorRecord:
    """A frozen dataclass whose tensors (nested ones too) move and stack together."""

    def to(self: S, *args: Any, **kwargs: Any) -> S:
        """A copy with every tensor sent through ``Tensor.to``; integer labels keep their dtype."""
        return self._each(lambda value: _to(value, *args, **kwargs))

    def pin_memory(self: S) -> S:
        """A copy in page-locked memory, from which copies to a GPU run beside computations."""
        return self._each(lambda value: value.pin_memory())

    def _each(self: S, change: Callable[[Tensor], Tensor]) -> S:
        # Fields of other types, such as sizes, stay as they are.
        changes: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, TensorRecord):
                changes[field.name] = value._each(change)
            elif isinstance(value, Tensor):
                changes[field.name] = change(value)
        return replace(self, **changes)

    def __getitem__(self: S, index: slice | Tensor) -> S:
        """The batch items of a slice or at indices ``[n]``; the batch dimension stays."""
        # An integer would drop the batch dimension.
        if isinstance(index, int):
            raise TypeError(
                f"{type(self).__name__} takes a slice of the batch, got {index!r}"
            )
        return self._each(lambda value: value[index])


def _to(value: Tensor, *args: Any, **kwargs: Any) -> Tensor:
    if value.is_floating_point():
        return value.to(*args, **kwargs)

    # Labels and masks move, but keep their dtype.
    kwargs.pop("dtype", None)
    args = tuple(value for value in args if not isinstance(value, torch.dtype))
    return value.to(*args, **kwargs) if args or kwargs else value


def cat(records: Sequence[S]) -> S:
    """Joins records of one type along the batch dimension.

    Raises:
        ValueError: when the list is empty, or a field is present in some records only.
    """
    if not records:
        raise ValueError("cat: expected at least one record, got none")

    # Tensors are joined; all other values must be equal.
    first = records[0]
    changes = {}
    for field in fields(first):
        values = [getattr(record, field.name) for record in records]
        # A field that is None in one record must be None in all.
        if len({value is None for value in values}) == 2:
            raise ValueError(
                f"cat: {type(first).__name__}.{field.name} is present in some records only"
            )

        # Records may hold other records.
        if isinstance(values[0], TensorRecord):
            changes[field.name] = cat(values)
        elif isinstance(values[0], Tensor):
            changes[field.name] = torch.cat(values)
        elif any(value != values[0] for value in values):
            raise ValueError(
                f"cat: {type(first).__name__}.{field.name} differs between records: {values}"
            )
    return replace(first, **changes)
