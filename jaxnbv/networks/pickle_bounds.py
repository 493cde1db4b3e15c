"""Checks the memory and the nesting depth of a pickle before the pickle is loaded."""

import mmap
import pickletools
from collections.abc import Iterator
from io import BytesIO
from typing import Any

from jaxnbv.checks import require

_PUTS, _GETS = ("PUT", "BINPUT", "LONG_BINPUT"), ("GET", "BINGET", "LONG_BINGET")
# Operations that take objects from the stack, modify the first of them, and put it back.
_CHANGES = ("APPEND", "APPENDS", "SETITEM", "SETITEMS", "ADDITEMS", "BUILD")
# Python hashes nested tuples by recursion without a depth limit, which could overflow the C stack.
_MAX_DEPTH = 500


def skip_pickle(file: BytesIO | mmap.mmap, size: int) -> None:
    """Check the next pickle in a file and advance the file past the pickle, without creating its objects.

    - `size`: size of the file in bytes.

    **Raises:** `ValueError` if the pickle is damaged, needs more memory than a file of this size can fill, or is nested
    too deeply.
    """
    start = file.tell()
    # Nesting depth of each object on the unpickler's stack.
    stack: list[int] = []
    marks: list[int] = []
    memo: dict[int, int] = {}
    operations: Iterator[tuple[Any, Any, Any]] = pickletools.genops(file)  # type: ignore[arg-type]
    for code, argument, position in operations:
        if code.name in _PUTS:
            room = position - start
            require(argument <= room, f"asks for room for {argument} things in {room} bytes: it is damaged")
            memo[argument] = stack[-1]
        elif code.name == "MEMOIZE":
            memo[len(memo)] = stack[-1]
        elif code.name in _GETS:
            stack.append(memo[argument])
        elif code.name == "FRAME":
            is_whole = argument <= size - position
            require(is_whole, f"declares a frame of {argument} bytes, more than it has: it is damaged")
        elif code.name == "MARK":
            marks.append(len(stack))
        elif code.name == "DUP":
            stack.append(stack[-1])
        elif code.name == "POP" and marks and marks[-1] == len(stack):
            marks.pop()
        else:
            takes = code.stack_before
            first = len(stack) - len(takes)
            if pickletools.markobject in takes:
                first = marks.pop() - takes.index(pickletools.markobject)
            require(first >= 0, "takes more objects than it has made: it is damaged")
            depths = stack[first:]
            del stack[first:]
            depth = 1 + max(depths[code.name in _CHANGES :], default=-1)
            depth = max([depth, *depths[: code.name in _CHANGES]])
            require(depth <= _MAX_DEPTH, f"nests {depth} deep, more than any model: it is damaged")
            stack += [depth] * len(code.stack_after)
