"""How far long work has come: a bar with its stage and the time that has passed, on a terminal alone."""

from collections.abc import Iterable
from typing import Any

from tqdm import tqdm


def progress_bar(
    items: Iterable[Any] | None = None, wanted: bool = True, leave: bool = False, **settings: Any
) -> "tqdm[Any]":
    """A bar over some items, or of a `total`; none where it is not wanted, or what is written goes to a file.

    - `leave`: whether it stays once it is full; `settings`: others of tqdm, such as `desc`.
    """
    # What remains is a guess, and a poor one: the first of some steps compiles.
    form = "{desc}: {n_fmt} of {total_fmt} |{bar:20}| {elapsed}"
    return tqdm(items, leave=leave, disable=None if wanted else True, bar_format=form, **settings)
