"""The version of the installed distribution, and the versions of JAX that it accepts."""

import importlib.metadata

from packaging.requirements import Requirement

__version__ = importlib.metadata.version("jaxnbv")


def check_jax(installed: str) -> None:
    """Refuse a version of jaxlib that the package's requirements exclude.

    Such versions compute wrong values on CPUs. `pip` does not install such versions with jaxnbv, but may do so
    afterwards.

    **Raises:** `ImportError` with the accepted versions.
    """
    needed = map(Requirement, importlib.metadata.requires("jaxnbv") or ())
    accepted = next(need.specifier for need in needed if need.name == "jax")
    if not accepted.contains(installed, prereleases=True):
        raise ImportError(
            f"jaxlib {installed} is installed, which is too old, computes wrong values on CPUs or crashes there "
            f"(jax issues 39103 and 39257): pip install -U 'jax{accepted}'"
        )
