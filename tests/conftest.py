"""Shapes and types of every public signature are checked while the tests run."""

import ctypes
import gc
import importlib.metadata
import os
from pathlib import Path

# Before NumPy, SciPy and JAX are loaded, and for the processes that tests start. Workers whose linear algebra takes all
# cores each wait for one another, and so do those that compile in several threads. Most programs of the tests run for
# less time than they take to compile: neither LLVM's passes nor wide registers nor XLA's newer emitters of fused loops
# pay. Modules that compute for long, some five times longer so, say COMPUTES = True. What one worker has compiled the
# others find, if it took longer than reading it back. Tracing makes and drops many small objects: collecting them as
# often as Python does by default takes a tenth of the time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
# Versions of XLA after 0.9 have no older emitters, and end a process that asks for them.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_llvm_disable_expensive_passes=true --xla_cpu_prefer_vector_width=128 "
    "--xla_cpu_parallel_codegen_split_count=1"
    + (" --xla_cpu_use_fusion_emitters=false" if importlib.metadata.version("jaxlib").startswith("0.9.") else ""),
)
# As `keep_compiled` says.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).resolve().parents[1] / ".pytest_cache" / "xla"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

import jax
import numpy as np
import psutil
import pytest
from jaxtyping import install_import_hook

gc.set_threshold(100_000, 20, 100)
install_import_hook(["jaxnbv", "forecasts", "covering", "peers", "training", "training_clouds"], "beartype.beartype")

# Bytes of a worker.
MEMORY = 3 << 30
SHARED = Path(__file__).resolve().parents[2] / "shared"


# A worker takes files as a whole, so that what a module prepares is prepared once; the longest come first.
LONGEST_FIRST = (
    "test_cli.py",
    "test_notebooks.py",
    "test_pages.py",
    "test_means.py",
    "test_known_shapes.py",
    "test_gradient.py",
    "test_spsr.py",
    "test_pose_gradients.py",
    "test_trajectories.py",
    "test_screened.py",
    "test_processes.py",
    "test_report.py",
)


def pytest_collection_modifyitems(items):
    def place(item):
        """Those that compute come together: what was compiled for the others is of no use to them."""
        name = item.path.name
        return LONGEST_FIRST.index(name) if name in LONGEST_FIRST else 99, not getattr(item.module, "COMPUTES", False)

    items.sort(key=place)


def compile_for_speed(wanted):
    jax.clear_caches()
    gc.collect()
    # The C library keeps what was freed, by which the next module would look as large.
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
    jax.config.update("jax_disable_most_optimizations", not wanted)


@pytest.fixture(scope="module", autouse=True)
def compiled_programs(request):
    """As a module asks for them; let go before they fill the memory, which those of a whole run would."""
    computes = getattr(request.module, "COMPUTES", False)
    if computes == jax.config.values["jax_disable_most_optimizations"] or psutil.Process().memory_info().rss > MEMORY:
        compile_for_speed(computes)


@pytest.fixture
def computes():
    """For a single test that computes for long."""
    compile_for_speed(True)
    yield
    compile_for_speed(False)


@pytest.fixture(autouse=True)
def random_numbers_of_its_own(request):
    """A test draws the same numbers from its module's generator whichever tests ran before it."""
    if hasattr(request.module, "RNG"):
        request.module.RNG = np.random.default_rng(0)


@pytest.fixture
def compilations():
    """Names of events by which JAX tells of a compilation, eager operations included, in the order they came."""
    seen = []

    def listen(event, duration, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            seen.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield seen
    jax.monitoring.unregister_event_duration_listener(listen)


@pytest.fixture
def x64():
    """Double precision for one test, for comparison with float64 oracles."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="session")
def shared():
    """The maintainers' folder of reference numbers and meshes, which users do not have."""
    if not SHARED.is_dir():
        pytest.skip("the maintainers' reference data is not beside this checkout")
    return SHARED
