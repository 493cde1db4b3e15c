"""The version of the installed distribution, and the versions of JAX that it accepts."""

import importlib.metadata

from packaging.requirements import Requirement

__version__ = importlib.metadata.version("jaxnbv")


def check_jax(jaxlib_version: str) -> None:
    """Refuse a version of jaxlib that the package excludes, but a later `pip install` may install.

    **Raises:** `ImportError` with the accepted versions.
    """
    requirements = map(Requirement, importlib.metadata.requires("jaxnbv") or ())
    specifier = next(requirement.specifier for requirement in requirements if requirement.name == "jax")
    if not specifier.contains(jaxlib_version, prereleases=True):
        raise ImportError(
            f"jaxlib {jaxlib_version} is installed, which is too old, computes wrong values on CPUs or crashes there "
            f"(jax issues 39103 and 39257): pip install -U 'jax{specifier}'"
        )
