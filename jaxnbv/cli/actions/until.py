"""When views are enough, on the command line: `--until sure=0.95 --until seconds=60`."""

import functools
import operator
from collections.abc import Sequence

from jaxnbv.checks import InputError, require
from jaxnbv.cli.registry import STOPS, resolve
from jaxnbv.tasks import Stop

NEVER = "never"


def rule(texts: Sequence[str]) -> Stop | None:
    """The rule that some options make together; None for none, or "never".

    **Raises:** `ValueError` for a name that is not known, or what is no number.
    """
    if not texts or list(texts) == [NEVER]:
        return None
    return functools.reduce(operator.or_, map(_rule, texts))


def _rule(text: str) -> Stop:
    name, _, value = text.partition("=")
    require(name in STOPS, f"--until is {text!r}: give {NEVER} or one of {', '.join(STOPS)}, such as sure=0.95")
    try:
        number = float(value)
    except ValueError as error:
        raise InputError(f"--until is {text!r}: give a number, such as {name}=0.95") from error
    return resolve(STOPS[name].stop)(number)
