"""Compiled programs that are kept on disk, so that the next process need not compile them again."""

import importlib.metadata
import os
import sys
import tempfile
from pathlib import Path

import platformdirs

from jaxnbv.errors import InputError

_FOLDER = "jax_compilation_cache_dir"
# JAX would leave out what compiles within a second, which are most of the programs of a step.
_THRESHOLDS = {"jax_persistent_cache_min_compile_time_secs": 0.0, "jax_persistent_cache_min_entry_size_bytes": 0}


def keep_compiled(folder: str | Path | None = None) -> str:
    """Keep what JAX compiles, for later processes and for those that this one starts. Call it before the first step,
    which compiles for 10 to 90 seconds, and hardly does where the programs are kept.

    - `folder`: by default the one that JAX was given (`JAX_COMPILATION_CACHE_DIR`), else one in the user's cache. To
      be removed at any time, for nothing else empties it.

    Returns the folder.

    **Raises:** `ValueError` if no file can be written there.
    """
    # Imported or not: where it is not, it reads the environment later.
    jax = sys.modules.get("jax")
    given = getattr(jax.config, _FOLDER) if jax else os.environ.get(_FOLDER.upper())
    kept = str(folder or given or platformdirs.user_cache_path("jaxnbv") / "xla")
    # A bucket in the cloud is JAX's to check.
    if "://" not in kept:
        _check_writable(Path(kept))
    if importlib.metadata.version("jaxlib").startswith("0.9."):
        # On many CPUs it writes two long lines about every program that it reads, and runs it (jax issue 38445).
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    os.environ[_FOLDER.upper()] = kept
    for name, value in _THRESHOLDS.items():
        os.environ.setdefault(name.upper(), str(value))
    if jax:
        from jax.experimental.compilation_cache import compilation_cache

        jax.config.update(_FOLDER, kept)
        for name, value in _THRESHOLDS.items():
            jax.config.update(name, type(value)(os.environ[name.upper()]))
        # What was compiled before has fixed the folder.
        compilation_cache.reset_cache()
    return kept


def _check_writable(folder: Path) -> None:
    """**Raises:** `ValueError`, in place of a warning of JAX's for each program."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(
            f"compiled programs cannot be kept in {folder} ({error}): give keep_compiled a folder that can be written, "
            "or set JAX_COMPILATION_CACHE_DIR to one"
        ) from error
