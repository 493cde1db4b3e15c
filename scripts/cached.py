"""Data that takes long to make, kept in a file for the next run."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from tqdm import tqdm


def cached(path: Path, steps: Iterable[Any], make: Callable[[Any], Any]) -> list[np.ndarray]:
    """The leaves of what `make` gives for each step, one behind the other, from the file where it exists."""
    if not path.exists():
        parts = [jax.tree.map(np.asarray, jax.tree.leaves(make(step))) for step in tqdm(steps, desc=path.stem)]
        leaves = [np.concatenate(rows) for rows in zip(*parts, strict=True)]
        partial = path.with_suffix(".partial")
        with partial.open("wb") as file:
            np.savez(file, *leaves)
        partial.replace(path)
    with np.load(path) as saved:
        return [saved[name] for name in saved.files]
