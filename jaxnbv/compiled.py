"""Cache of compiled programs on disk, so that later processes do not compile them again."""

import importlib.metadata
import os
import sys
import tempfile
from pathlib import Path

import platformdirs

from jaxnbv.errors import InputError

# The variable that names the folder of the package's own programs.
PROGRAMS = "JAXNBV_PROGRAMS"
_FOLDER = "jax_compilation_cache_dir"
# By default JAX leaves out programs that compile within a second, which most programs of a step do.
_THRESHOLDS = {"jax_persistent_cache_min_compile_time_secs": 0.0, "jax_persistent_cache_min_entry_size_bytes": 0}


def keep_compiled(folder: str | Path | None = None) -> str:
    """Keep the programs that JAX compiles for later processes and child processes. Returns the folder.

    Call it before the first step. Compiling takes 10 to 90 seconds. Later processes load the package's own programs in
    two seconds without tracing them again (see `jaxnbv.programs`), and what else JAX compiles from its cache.

    - `folder`: by default that of JAX (`JAX_COMPILATION_CACHE_DIR`), else one in the user's cache. Nothing empties it,
      and you may delete it at any time.

    **Raises:** `ValueError` if no file can be written there.
    """
    # If JAX is not imported yet, it will read the environment variables.
    jax = sys.modules.get("jax")
    configured = getattr(jax.config, _FOLDER) if jax else os.environ.get(_FOLDER.upper())
    path = str(folder or configured or platformdirs.user_cache_path("jaxnbv") / "xla")
    # JAX itself checks buckets in the cloud.
    if "://" not in path:
        _check_writable(Path(path))
        os.environ[PROGRAMS] = str(Path(path) / "programs")
    if importlib.metadata.version("jaxlib").startswith("0.9."):
        # This version logs two long lines on many CPUs for each program that it reads, and runs it (jax issue 38445).
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    os.environ[_FOLDER.upper()] = path
    for name, value in _THRESHOLDS.items():
        os.environ.setdefault(name.upper(), str(value))
    if jax:
        from jax.experimental.compilation_cache import compilation_cache

        jax.config.update(_FOLDER, path)
        for name, value in _THRESHOLDS.items():
            jax.config.update(name, type(value)(os.environ[name.upper()]))
        # Earlier compilations have already fixed the folder.
        compilation_cache.reset_cache()
    return path


def _check_writable(folder: Path) -> None:
    """**Raises:** `ValueError` if the folder cannot be written. JAX would only warn, once for each program."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(
            f"compiled programs cannot be kept in {folder} ({error}): give keep_compiled a folder that can be written, "
            "or set JAX_COMPILATION_CACHE_DIR to one"
        ) from error
