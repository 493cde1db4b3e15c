"""Data that takes long to make, kept in files for the next run."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from jaxnbv.storage.files import make_folder, write_whole


def cached(folder: Path, steps: Iterable[int], make: Callable[[int], Any]) -> list[np.ndarray]:
    """The leaves of what `make` gives for each step, one behind the other; each step has a file of its own.

    A run that was interrupted makes those that are missing.
    """
    parts = []
    for step in tqdm(steps, desc=folder.name):
        path = make_folder(folder) / f"{step:06d}.npz"
        if not path.exists():
            leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(make(step))]
            write_whole(path, lambda file, leaves=leaves: np.savez(file, *leaves))
        with np.load(path) as saved:
            parts.append([saved[name] for name in saved.files])
    return [np.concatenate(rows) for rows in zip(*parts, strict=True)]
