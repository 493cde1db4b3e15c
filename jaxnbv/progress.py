"""A progress bar with stage and elapsed time, shown on terminals only."""

from collections.abc import Iterable
from typing import Any

from tqdm import tqdm


def progress_bar(
    items: Iterable[Any] | None = None, enabled: bool = True, leave: bool = False, **settings: Any
) -> "tqdm[Any]":
    """Return tqdm's progress bar over `items`. It is shown only if `enabled`, and only on a terminal.

    - `leave`: whether the bar stays on the screen once it is full.
    - `settings`: further arguments of tqdm, such as `total`, the number of items.
    """
    # The bar shows no remaining time. The first step compiles, so the estimate would be poor.
    bar_format = "{desc}: {n_fmt} of {total_fmt} |{bar:20}| {elapsed}"
    return tqdm(items, leave=leave, disable=None if enabled else True, bar_format=bar_format, **settings)
