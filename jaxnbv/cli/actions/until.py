"""When views are enough, on the command line: `--until sure=0.95 --until seconds=60`."""

import functools
import operator
from collections.abc import Callable, Sequence

from jaxnbv.checks import InputError, require
from jaxnbv.planning.stopping import Budget, ValueBelow
from jaxnbv.tasks import Covered, Found, Stop, Sure

NEVER = "never"
RULES: dict[str, Callable[[float], Stop]] = {
    "sure": Sure,
    "found": lambda number: Found(int(number) if number.is_integer() else number),  # type: ignore[arg-type]
    "covered": Covered,
    "value-below": ValueBelow,
    "seconds": lambda number: Budget(seconds=number),
    "travel": lambda number: Budget(cost=number),
}


def rule(texts: Sequence[str]) -> Stop | None:
    """The rule that some options make together; None for none, or "never".

    **Raises:** `ValueError` for a name that is not known, or what is no number.
    """
    if not texts or list(texts) == [NEVER]:
        return None
    return functools.reduce(operator.or_, map(_rule, texts))


def _rule(text: str) -> Stop:
    name, _, value = text.partition("=")
    require(name in RULES, f"--until is {text!r}: give {NEVER} or one of {', '.join(RULES)}, such as sure=0.95")
    try:
        number = float(value)
    except ValueError as error:
        raise InputError(f"--until is {text!r}: give a number, such as {name}=0.95") from error
    return RULES[name](number)
