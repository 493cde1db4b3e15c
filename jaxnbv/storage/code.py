"""Inspects code: the names and sources of functions, and the globals that functions read."""

import contextlib
import dis
import importlib.util
import inspect
import sys
import sysconfig
import textwrap
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FunctionType, GetSetDescriptorType, MemberDescriptorType, ModuleType
from typing import Any, NamedTuple

from jaxnbv.errors import InputError

_STDLIB = sysconfig.get_path("stdlib")
# Methods that Python generates for dataclasses and named tuples.
_GENERATED = {"__init__", "__repr__", "__eq__", "__lt__", "__le__", "__gt__", "__ge__", "__hash__", "__new__"} | {
    f"__{name}__" for name in ("setattr", "delattr", "replace")
}
# Flag in a class's `__flags__` for classes that are made at run time, by a class statement or by a C library.
_HEAP_TYPE = 1 << 9
_SLOTS = MemberDescriptorType | GetSetDescriptorType | type(NamedTuple("_", [("a", int)]).a)  # type: ignore[attr-defined]


def lookup(name: str) -> Any:
    """Look up an object of an imported module by its name, "module:qualified.name"; None if absent."""
    module, _, path = name.partition(":")
    value: Any = sys.modules.get(module)
    for part in path.split("."):
        # Read `__dict__`, because getattr could run code.
        value = getattr(value, "__dict__", {}).get(part)
        value = value.__func__ if isinstance(value, classmethod | staticmethod) else value
    return value


def name_of(obj: Any) -> str:
    """Return the module and qualified name of a class or function, for `lookup`; "" for other objects."""
    qualified_name = getattr(obj, "__qualname__", None) or getattr(obj, "__name__", None)
    module = getattr(obj, "__module__", None) or getattr(getattr(obj, "__objclass__", None), "__module__", None)
    if not isinstance(qualified_name, str) or not isinstance(module, str):
        return ""
    if lookup(f"{module}:{qualified_name}") is not obj:
        # Name a lambda, or a function that was made inside a function, after a global variable that holds it.
        names = vars(sys.modules.get(module, object))
        qualified_name = next((name for name in list(names) if names[name] is obj), qualified_name)
    return f"{module}:{qualified_name}"


def is_installed(module: str | None) -> bool:
    """Return whether a module belongs to jaxnbv, Python or an installed package.

    The code of such a module changes only with the version of its package.
    """
    package = str(module).partition(".")[0]
    if package == "jaxnbv":
        return True
    try:
        spec = importlib.util.find_spec(package)
    # `find_spec` raises these errors for modules without a file, such as __main__.
    except (ValueError, ImportError):
        return False
    locations = [] if spec is None else [spec.origin, *(spec.submodule_search_locations or ())]
    return any(
        location in ("built-in", "frozen")
        or {"site-packages", "dist-packages"} & {*Path(location).parts}
        or Path(location).is_relative_to(_STDLIB)
        for location in locations
        if location
    )


class _Plain:
    pass


def is_plain(obj: Any) -> bool:
    """Return whether the whole state of an object is in its `__dict__`, not in slots or a C library."""
    kind = type(obj)
    has_slots = any(isinstance(member, MemberDescriptorType) for base in kind.__mro__ for member in vars(base).values())
    is_python_class = bool(kind.__flags__ & _HEAP_TYPE) and kind.__basicsize__ == _Plain.__basicsize__
    return kind is object or (is_python_class and not has_slots)


def closure(function: FunctionType) -> dict[str, Any]:
    """Return the values of a function's closure variables, keyed by name. Unset variables are absent."""
    values = {}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with contextlib.suppress(ValueError):
            values[name] = cell.cell_contents
    return values


def globals_read(code: CodeType, names: dict[str, Any], path: str) -> Iterator[tuple[str, Any]]:
    """Yield the name and value of each global variable that code reads.

    If the code reads an attribute of a user's module, as in `module.attribute`, yields this attribute instead of the
    module.

    - `names`: all global variables, as values keyed by name.
    - `path`: see `describe`.

    **Raises:** `ValueError` if the code imports a user's module.
    """
    steps = [step for step in dis.get_instructions(code) if step.opname != "EXTENDED_ARG"]
    for index, step in enumerate(steps):
        if step.opname == "IMPORT_NAME" and not is_installed(step.argval):
            raise InputError(
                f"{path} imports {step.argval or 'a module'} while it runs: import it at the top of the file"
            )
        if step.opname in ("LOAD_GLOBAL", "LOAD_NAME") and step.argval in names:
            name, value = step.argval, names[step.argval]
            for attribute in steps[index + 1 :]:
                is_user_module = isinstance(value, ModuleType) and not is_installed(value.__name__)
                if (
                    not is_user_module
                    or attribute.opname not in ("LOAD_ATTR", "LOAD_METHOD")
                    or not hasattr(value, attribute.argval)
                ):
                    break
                name, value = f"{name}.{attribute.argval}", getattr(value, attribute.argval)
            yield name, value
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from globals_read(constant, names, path)


def is_user_defined(name: str, member: Any) -> bool:
    """Return whether a member of a class was written by the class's author, not generated by Python."""
    function = getattr(member, "__func__", member)
    if isinstance(function, FunctionType):
        is_generated = name in _GENERATED and function.__code__.co_filename == "<string>"
        return not is_generated and function.__globals__.get("__name__") != "collections"
    return not (name.startswith("__") or name == "_abc_impl" or isinstance(member, _SLOTS))


def source_of(function: FunctionType, path: str) -> str:
    """Return the source code of a function, or the body of a lambda, as text.

    - `path`: see `describe`.

    **Raises:** `ValueError` if the source cannot be read.
    """
    code = function.__code__
    try:
        text = textwrap.dedent(inspect.getsource(code))
    except (OSError, TypeError) as error:
        raise InputError(
            f"{path or 'this'} is the function {function.__qualname__}, whose source cannot be read: define it in a "
            f'file, or give it a version that you change whenever it changes, {function.__name__}.version = "1"'
        ) from error
    if function.__name__ != "<lambda>":
        return text
    lines, _ = inspect.findsource(code)
    # A line may have several lambdas, so find the body from the source positions of its instructions. Positions of zero
    # width belong to no expression.
    spans = [(a, b, c, d) for a, b, c, d in code.co_positions() if a and b and c is not None and d]
    (first, start), (last, end) = min((a, c) for a, _, c, _ in spans), max((b, d) for _, b, _, d in spans)
    body = [line.encode() for line in lines[first - 1 : last]]
    body[-1] = body[-1][:end]
    body[0] = body[0][start:]
    return b"".join(body).decode()
