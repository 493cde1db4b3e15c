"""What a pickle asks for, before it is read: memory that its file can fill, and nesting that Python can follow."""

import mmap
import pickletools
from collections.abc import Iterator
from io import BytesIO
from typing import Any

from jaxnbv.checks import require

_PUTS, _GETS = ("PUT", "BINPUT", "LONG_BINPUT"), ("GET", "BINGET", "LONG_BINGET")
# These change the first thing that they take off the stack.
_CHANGES = ("APPEND", "APPENDS", "SETITEM", "SETITEMS", "ADDITEMS", "BUILD")
# Tuples within tuples: Python hashes them by recursion that it does not limit.
_DEEPEST = 500


def skip_pickle(file: BytesIO | mmap.mmap, size: int) -> None:
    """Pass over a pickle in a file of this many bytes, without making what it describes.

    **Raises:** `ValueError` for one that is damaged, asks for more memory than a file of its size can fill, or nests
    too deep.
    """
    start = file.tell()
    # Of each thing on the stack, how deep it nests.
    stack: list[int] = []
    marks: list[int] = []
    memo: dict[int, int] = {}
    operations: Iterator[tuple[Any, Any, Any]] = pickletools.genops(file)  # type: ignore[arg-type]
    for code, argument, at in operations:
        if code.name in _PUTS:
            require(argument <= at - start, f"asks for room for {argument} things in {at - start} bytes: it is damaged")
            memo[argument] = stack[-1]
        elif code.name == "MEMOIZE":
            memo[len(memo)] = stack[-1]
        elif code.name in _GETS:
            stack.append(memo[argument])
        elif code.name == "FRAME":
            require(argument <= size - at, f"declares a frame of {argument} bytes, more than it has: it is damaged")
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
            require(first >= 0, "takes more than it has made: it is damaged")
            held = stack[first:]
            del stack[first:]
            depth = 1 + max(held[code.name in _CHANGES :], default=-1)
            depth = max([depth, *held[: code.name in _CHANGES]])
            require(depth <= _DEEPEST, f"nests {depth} deep, more than any model: it is damaged")
            stack += [depth] * len(code.stack_after)
