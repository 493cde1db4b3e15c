"""The plain values of a pickle, which is a program: it is interpreted here, not handed to Python's own machine.

Numbers, strings, tuples, lists and dictionaries are built; a name stands for what a table of names says, and anything
else is refused. What a hostile file may do is bounded by its length: keys are strings or integers, tuples hold at most
tuples without tuples, and what all calls together copy is no longer than the file, so that nothing is hashed, compared,
shown or kept that is.
"""

import pickletools
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from jaxnbv.checks import InputError, require

_PLAIN = {
    *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"),
    *("STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8"),
    *("BINBYTES", "SHORT_BINBYTES", "BINBYTES8"),
}
_MARK = object()
# A short text may be stored once and used by many calls, of eight bytes each.
_COPIES = 2
_MADE: Mapping[str, Callable[[], Any]] = {
    "NONE": lambda: None,
    "NEWTRUE": lambda: True,
    "NEWFALSE": lambda: False,
    "EMPTY_TUPLE": tuple,
    "EMPTY_LIST": list,
    "EMPTY_DICT": dict,
    "MARK": lambda: _MARK,
}


class Function(NamedTuple):
    """What a pickle may call."""

    call: Callable[..., Any]


class Mutable(ABC):
    """What a pickle may give a state after it was made."""

    @abstractmethod
    def set_state(self, state: Any) -> None:
        """Take the state."""


class _OfTuples(tuple):
    """A tuple that holds tuples; none holds it."""


def unpickle(file: Any, length: int, name: Callable[[str, str], Any], persistent: Callable[[Any], Any]) -> Any:
    """The next pickle of a binary file.

    - `length`: of the file, in bytes.
    - `name`: says what stands for the name of a module; `persistent`: what stands for an identifier.

    **Raises:** `ValueError` for operations, keys and nested tuples that no PyTorch file has; nearly anything for a
    pickle that is damaged.
    """
    return _Machine(length, name, persistent).run(file)


def dictionary(pairs: Any = ()) -> dict:
    """A dictionary of pairs.

    **Raises:** `ValueError` for a key that is neither a string nor an integer.
    """
    made = {}
    for key, value in pairs:
        require(isinstance(key, str | int), "a dictionary has a key that is neither a string nor an integer")
        made[key] = value
    return made


class _Machine:
    def __init__(self, length: int, name: Callable[[str, str], Any], persistent: Callable[[Any], Any]):
        self.name, self.persistent = name, persistent
        self.copies_left = _COPIES * length
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}

    def run(self, file: Any) -> Any:
        for code, argument, _ in pickletools.genops(file):
            if code.name in _MADE:
                self.stack.append(_MADE[code.name]())
            elif code.name in _PLAIN:
                self.stack.append(argument)
            else:
                self.step(code.name, argument)
        return self.stack.pop()

    def step(self, code: str, argument: Any) -> None:
        stack = self.stack
        match code:
            case "PROTO" | "FRAME" | "STOP":
                pass
            case "POP":
                stack.pop()
            case "POP_MARK":
                self.marked()
            case "DUP":
                stack.append(stack[-1])
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                stack.append(_tuple(self.last(int(code[-1]))))
            case "TUPLE":
                stack.append(_tuple(self.marked()))
            case "LIST":
                stack.append(self.marked())
            case "DICT":
                stack.append(_pairs(self.marked()))
            case "APPEND" | "APPENDS":
                values = self.last(1) if code == "APPEND" else self.marked()
                require(isinstance(stack[-1], list), "appends to something other than a list: the file is damaged")
                stack[-1].extend(values)
            case "SETITEM" | "SETITEMS":
                values = self.last(2) if code == "SETITEM" else self.marked()
                require(isinstance(stack[-1], dict), "sets items of something other than a dictionary: damaged")
                stack[-1].update(_pairs(values))
            case "GLOBAL" | "STACK_GLOBAL":
                module, name = argument.split(" ", 1) if code == "GLOBAL" else self.last(2)
                require(isinstance(module, str) and isinstance(name, str), "a name is not text: the file is damaged")
                stack.append(self.name(module, name))
            case "PERSID" | "BINPERSID":
                stack.append(self.persistent(argument if code == "PERSID" else stack.pop()))
            case "REDUCE":
                function, arguments = self.last(2)
                called = isinstance(function, Function) and isinstance(arguments, tuple)
                require(called, "calls something other than a function: the file is damaged")
                self.copies_left -= sum(map(_copied, arguments))
                require(self.copies_left >= 0, "refused: calls copy more than the file holds")
                stack.append(function.call(*arguments))
            case "BUILD":
                state, target = stack.pop(), stack[-1]
                # The state of a dictionary, the model's, tells the versions of its modules.
                require(isinstance(target, Mutable | dict), "gives a state to what has none: the file is damaged")
                if isinstance(target, Mutable):
                    target.set_state(state)
            case "PUT" | "BINPUT" | "LONG_BINPUT" | "MEMOIZE":
                self.memo[len(self.memo) if code == "MEMOIZE" else int(argument)] = stack[-1]
            case "GET" | "BINGET" | "LONG_BINGET":
                stack.append(self.memo[int(argument)])
            case _:
                raise InputError(f"refused: the file uses pickle's {code}, which tensors do not need")

    def last(self, count: int) -> list:
        require(len(self.stack) >= count, "the pickle takes more values than it has: the file is damaged")
        taken = self.stack[-count:]
        del self.stack[-count:]
        return taken

    def marked(self) -> list:
        """The values since the last mark."""
        taken = []
        while (value := self.stack.pop()) is not _MARK:
            taken.append(value)
        return taken[::-1]


def _copied(argument: Any) -> int:
    """What a call may copy of an argument, in bytes of a pickle; each entry of a list takes several."""
    if isinstance(argument, str | bytes):
        return len(argument)
    return 4 * len(argument) if isinstance(argument, list | tuple | dict) else 0


def _tuple(values: list) -> tuple:
    require(not any(isinstance(value, _OfTuples) for value in values), "refused: tuples are nested too deep")
    return (_OfTuples if any(isinstance(value, tuple) for value in values) else tuple)(values)


def _pairs(values: list) -> dict:
    require(len(values) % 2 == 0, "a key has no value: the file is damaged")
    return dictionary(zip(values[::2], values[1::2], strict=True))
