"""Looks at a pickle's instructions, and at what it built, so that neither takes memory or time.

A pickle of 100 bytes can name one tuple inside another a thousand times over: hashing, printing or
converting it then takes for ever, or overruns the stack. Both looks take a time proportional to the
file's length.
"""

from __future__ import annotations

import io
import pickle
import pickletools
from collections.abc import Iterable
from typing import Any, BinaryIO

import numpy as np

MOST_HASHED = 10_000
"""Entries of a tuple, nested ones counted as often as they occur: what hashing it may take."""
MOST_DEPTH = 100  # of lists, dicts and tuples in one another
GROWTH, SPARE_ENTRIES = 4, 10**6
"""Entries in all may be ``GROWTH`` times the file's bytes and ``SPARE_ENTRIES`` more."""
REFUSED_OPCODES = frozenset(
    {"EXT1", "EXT2", "EXT4", "PERSID", "BINPERSID", "NEXT_BUFFER", "READONLY_BUFFER"}
)
LENGTH_BYTES = {
    pickletools.TAKEN_FROM_ARGUMENT1: 1,
    pickletools.TAKEN_FROM_ARGUMENT4: 4,
    pickletools.TAKEN_FROM_ARGUMENT4U: 4,
    pickletools.TAKEN_FROM_ARGUMENT8U: 8,
}
OPCODES = {op.code.encode("latin1"): op for op in pickletools.opcodes}
TUPLES = {"EMPTY_TUPLE": 0, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3, "TUPLE": -1}
MARK = -1  # on the shadow of the stack, in place of a cost


def _effect(opcode: pickletools.OpcodeInfo) -> tuple[bool, int, list[int]]:
    """Whether it takes all down to the last mark, how many more, and the costs of what it makes."""
    before, mark = opcode.stack_before, pickletools.markobject
    below = before.index(mark) if mark in before else len(before)
    return mark in before, below, [MARK if kind is mark else 1 for kind in opcode.stack_after]


EFFECTS = {op.name: _effect(op) for op in pickletools.opcodes}


class Refused(pickle.UnpicklingError):
    """The pickle asks for something that is not on the list."""


def scan(data: bytes) -> None:
    """Checks a pickle's instructions one by one without following them.

    Every length must lie within the file and every memo index below the number of instructions:
    the unpickler would otherwise reserve whatever memory a damaged number asks for. No tuple may
    be larger than `MOST_HASHED`: as a key it would be hashed.

    Raises:
        pickle.UnpicklingError: on an unknown or refused instruction, or a number out of bounds.
    """
    stream, size, count, tuples = io.BytesIO(data), len(data), 0, _Tuples()
    while True:
        count += 1
        opcode = OPCODES.get(stream.read(1))
        if opcode is None:
            raise pickle.UnpicklingError("it ends early" if stream.tell() >= size else "no pickle")
        if opcode.name in REFUSED_OPCODES:
            raise Refused(f"objects kept outside the file ({opcode.name})")
        if opcode.name == "STOP":
            return
        argument: int | bytes = 0
        if opcode.arg is not None:
            argument = _argument(stream, opcode.arg.n, lines=2 if "pair" in opcode.arg.name else 1)
            bound = count if opcode.name.endswith("PUT") else size - stream.tell()
            limited = opcode.name in ("PUT", "BINPUT", "LONG_BINPUT", "FRAME")
            if limited and int(argument) > bound:
                raise pickle.UnpicklingError(f"{opcode.name} asks for more than the file holds")
        tuples.follow(opcode, argument)


class _Tuples:
    """The unpickler's stack and memo with, for each object, what hashing it takes."""

    def __init__(self) -> None:
        self.stack: list[int] = []
        self.memo: dict[int, int] = {}

    def follow(self, opcode: pickletools.OpcodeInfo, argument: int | bytes) -> None:
        """Does to the costs what the instruction does to the objects.

        Raises:
            pickle.UnpicklingError: on a tuple that is too large.
        """
        name, stack = opcode.name, self.stack
        if name in TUPLES:
            cost = 1 + sum(self._taken(TUPLES[name]))
            if cost > MOST_HASHED:
                raise pickle.UnpicklingError(f"a tuple of more than {MOST_HASHED} entries")
            stack.append(cost)
        elif name == "MEMOIZE":
            self.memo[len(self.memo)] = self._top()
        elif name.endswith("PUT"):
            self.memo[int(argument)] = self._top()
        elif name.endswith("GET"):
            stack.append(self.memo.get(int(argument), 1))
        elif name == "DUP":
            stack.append(self._top())
        else:
            self._others(opcode)

    def _others(self, opcode: pickletools.OpcodeInfo) -> None:
        """What none of these instructions makes is hashed by its contents."""
        to_mark, below, made = EFFECTS[opcode.name]
        if to_mark:
            self._taken(-1)
        self._taken(below)
        self.stack += made

    def _top(self) -> int:
        return max(self.stack[-1], 1) if self.stack else 1

    def _taken(self, count: int) -> list[int]:
        """The topmost ``count`` costs, or those down to the last mark; a short stack is no error.

        The unpickler itself complains of it.
        """
        if count == 0:
            return []
        start = max(len(self.stack) - count, 0)
        if count < 0:
            places = range(len(self.stack) - 1, -1, -1)
            start = next((i for i in places if self.stack[i] == MARK), 0)
        taken = self.stack[start:]
        del self.stack[start:]
        return [cost for cost in taken if cost != MARK]


def _argument(stream: BinaryIO, kind: int, lines: int) -> int | bytes:
    """Skips an instruction's argument; its number, where it is one."""
    if kind == pickletools.UP_TO_NEWLINE:
        text = [stream.readline() for _ in range(lines)]
        if not all(line.endswith(b"\n") for line in text):
            raise pickle.UnpicklingError("it ends early")
        return text[0]
    width = LENGTH_BYTES.get(kind, kind)
    content = stream.read(width)
    if len(content) != width:
        raise pickle.UnpicklingError("it ends early")
    number = int.from_bytes(content, "little")
    if kind in LENGTH_BYTES and len(_skip(stream, number)) < min(number, 1):
        raise pickle.UnpicklingError("it ends early")
    return number


def _skip(stream: BinaryIO, count: int) -> bytes:
    """Moves on by ``count`` bytes; the last of them, empty when the stream ends before."""
    if count == 0:
        return b""
    stream.seek(min(count - 1, 2**62), io.SEEK_CUR)
    return stream.read(1)


def check_unfolded(root: Any, size: int) -> None:
    """Refuses what is small in the file and endless once every reference is followed.

    Args:
        root: of dicts, lists, tuples and arrays of objects.
        size: bytes of the file.

    Raises:
        pickle.UnpicklingError: when it holds itself, is nested deeper than `MOST_DEPTH`, or unfolds
            to too many entries.
    """
    most, known, begun = GROWTH * size + SPARE_ENTRIES, dict[int, tuple[int, int]](), set[int]()
    todo = [(root, False)]
    while todo:
        value, done = todo.pop()
        parts = _parts(value)
        if done:
            inside = [known.get(id(part), (1, 0)) for part in parts]
            entries = 1 + sum(count for count, _ in inside)
            depth = 1 + max((deep for _, deep in inside), default=0)
            if entries > most or depth > MOST_DEPTH:
                raise pickle.UnpicklingError("it unfolds far larger or deeper than the file is")
            known[id(value)] = entries, depth
            begun.discard(id(value))
        elif id(value) in begun:
            raise pickle.UnpicklingError("it holds itself")
        elif parts and id(value) not in known:
            begun.add(id(value))
            todo.append((value, True))
            todo += [(part, False) for part in parts if _holds(part)]


def _parts(value: Any) -> Iterable[Any]:
    """What a container holds, the keys of a dict, which were hashed, left out."""
    if isinstance(value, dict):
        return list(value.values())
    if isinstance(value, np.ndarray):
        return value.reshape(-1).tolist() if value.dtype.hasobject else ()
    return value if isinstance(value, list | tuple) else ()


def _holds(value: Any) -> bool:
    return isinstance(value, dict | list | tuple | np.ndarray)
