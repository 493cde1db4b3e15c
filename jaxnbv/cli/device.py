"""What every command does before it begins."""

import os

import jax
import platformdirs

from jaxnbv.cli.registry import Device
from jaxnbv.errors import InputError


def prepare(device: Device) -> None:
    """Choose the device and keep compiled programs for later runs."""
    if device is not Device.AUTO:
        try:
            jax.config.update("jax_default_device", jax.devices(device.value)[0])
        except RuntimeError as error:
            raise InputError(
                f"no {device.value} that JAX can use ({error}): leave --device out, or install the extra named cuda"
            ) from error
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        jax.config.update("jax_compilation_cache_dir", str(platformdirs.user_cache_path("jaxnbv") / "xla"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
