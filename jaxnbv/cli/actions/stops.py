"""What the stopping rules of the command line stand for."""

from jaxnbv.planning.stopping import Budget, ValueBelow
from jaxnbv.tasks import Covered, Found, Stop, Sure


def sure(number: float) -> Stop:
    return Sure(number)


def found(number: float) -> Stop:
    return Found(int(number) if number.is_integer() else number)  # type: ignore[arg-type]


def covered(number: float) -> Stop:
    return Covered(number)


def value_below(number: float) -> Stop:
    return ValueBelow(number)


def seconds(number: float) -> Stop:
    return Budget(seconds=number)


def travel(number: float) -> Stop:
    return Budget(cost=number)
