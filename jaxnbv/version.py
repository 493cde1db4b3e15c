"""The version of the installed package, and a check of the version of JAX."""

import importlib.metadata

from packaging.requirements import Requirement

__version__ = importlib.metadata.version("jaxnbv")


def check_jax(jaxlib_version: str) -> None:
    """Check that the package supports this version of jaxlib. A later `pip install` may have changed it.

    **Raises:** `ImportError` with the supported versions.
    """
    requirements = map(Requirement, importlib.metadata.requires("jaxnbv") or ())
    specifier = next(requirement.specifier for requirement in requirements if requirement.name == "jax")
    if not specifier.contains(jaxlib_version, prereleases=True):
        raise ImportError(
            f"jaxlib {jaxlib_version} is installed, which is too old, computes wrong values on CPUs or crashes there "
            f"(jax issues 39103 and 39257): pip install -U 'jax{specifier}'"
        )
