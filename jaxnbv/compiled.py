"""Cache of compiled programs on disk, so that later processes do not compile them again."""

import importlib.metadata
import os
import sys
import tempfile
from pathlib import Path

import platformdirs

from jaxnbv.errors import InputError

# Environment variable with the path of the folder in which `jaxnbv.programs` stores programs.
PROGRAMS = "JAXNBV_PROGRAMS"
_FOLDER_OPTION = "jax_compilation_cache_dir"
# By default JAX does not store programs that compile within a second. Most programs of a step compile that fast.
_THRESHOLDS = {"jax_persistent_cache_min_compile_time_secs": 0.0, "jax_persistent_cache_min_entry_size_bytes": 0}


def keep_compiled(folder: str | Path | None = None) -> str:
    """Store compiled programs on disk for later processes and child processes, and return the folder.

    Call this before the first step. Compiling takes 10 to 90 seconds. Later processes load the package's own programs
    in two seconds without tracing them again (see `jaxnbv.programs`), and load other programs from JAX's cache.

    - `folder`: by default JAX's cache folder (`JAX_COMPILATION_CACHE_DIR`) if it is set, otherwise a folder in the
      user's cache. Nothing empties the folder automatically, and you may delete it at any time.

    **Raises:** `ValueError` if no file can be written to the folder.
    """
    # If JAX is not imported yet, it will read the environment variables.
    jax = sys.modules.get("jax")
    jax_folder = getattr(jax.config, _FOLDER_OPTION) if jax else os.environ.get(_FOLDER_OPTION.upper())
    path = str(folder or jax_folder or platformdirs.user_cache_path("jaxnbv") / "xla")
    # A path with :// is a bucket in the cloud, which JAX itself checks.
    if "://" not in path:
        _check_writable(Path(path))
        os.environ[PROGRAMS] = str(Path(path) / "programs")
    if importlib.metadata.version("jaxlib").startswith("0.9."):
        # On many CPUs, this version logs two long lines for each program that it loads, although the program runs
        # correctly (jax issue 38445).
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    os.environ[_FOLDER_OPTION.upper()] = path
    for name, value in _THRESHOLDS.items():
        os.environ.setdefault(name.upper(), str(value))
    if jax:
        from jax.experimental.compilation_cache import compilation_cache

        jax.config.update(_FOLDER_OPTION, path)
        for name, value in _THRESHOLDS.items():
            jax.config.update(name, type(value)(os.environ[name.upper()]))
        # Reset the cache, because its folder is fixed once JAX has compiled something.
        compilation_cache.reset_cache()
    return path


def _check_writable(folder: Path) -> None:
    """Raise `ValueError` if no file can be written to the folder. JAX would only warn, for each program."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(
            f"compiled programs cannot be kept in {folder} ({error}): give keep_compiled a folder that can be written, "
            "or set JAX_COMPILATION_CACHE_DIR to one"
        ) from error
