"""Fixtures and settings of all tests. Shapes and types of public signatures are checked while the tests run."""

import ctypes
import gc
import importlib.metadata
import os
from pathlib import Path

# These are set before NumPy, SciPy and JAX are loaded, and for the processes that tests start. Workers whose linear
# algebra or compiler uses all cores wait for each other. Most programs of the tests run for less time than they take to
# compile, so LLVM's passes, wide registers and XLA's newer emitters of fused loops do not pay. Modules that compute for
# long say COMPUTES = True (some take five times longer without). Workers share compiled programs through a cache, if
# compiling took longer than reading. Tracing makes and drops many small objects, and Python's default garbage
# collection would take a tenth of the time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
# Versions of XLA after 0.9 have no older emitters, and end a process that asks for them.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_llvm_disable_expensive_passes=true --xla_cpu_prefer_vector_width=128 "
    "--xla_cpu_parallel_codegen_split_count=1"
    + (" --xla_cpu_use_fusion_emitters=false" if importlib.metadata.version("jaxlib").startswith("0.9.") else ""),
)
# See `keep_compiled`.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).resolve().parents[1] / ".pytest_cache" / "xla"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

import jax
import numpy as np
import psutil
import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

gc.set_threshold(100_000, 20, 100)
install_import_hook(["jaxnbv", "forecasts", "covering", "peers", "training", "training_clouds"], "beartype.beartype")
# Every run draws the same examples, so that a failure can be repeated.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")

# .ci/run runs the tests marked as_users with this, so that they are compiled as users compile.
AS_USERS = os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] == "0"
# Memory of a worker in bytes.
MEMORY = 3 << 30
SHARED = Path(__file__).resolve().parents[2] / "shared"


# A worker takes whole files, so that fixtures of a module run once. The longest files come first.
LONGEST_FIRST = (
    "test_messages.py",
    "test_demo_command.py",
    "test_episodes.py",
    "test_depth_image.py",
    "test_pages.py",
    "test_means.py",
    "test_known_shapes.py",
    "test_gradient.py",
    "test_sessions.py",
    "test_parts.py",
    "test_hostile.py",
    "test_sharding.py",
    "test_pose_gradients.py",
    "test_notebooks.py",
    "test_report.py",
)


def pytest_collection_modifyitems(items):
    def place(item):
        """Modules that compute for long come together, because they share no programs with the others."""
        name = item.path.name
        return LONGEST_FIRST.index(name) if name in LONGEST_FIRST else 99, not getattr(item.module, "COMPUTES", False)

    items.sort(key=place)


def compile_for_speed(wanted):
    jax.clear_caches()
    gc.collect()
    # The C library keeps freed memory, which would count for the next module.
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
    jax.config.update("jax_disable_most_optimizations", not wanted)


@pytest.fixture(scope="module", autouse=True)
def compiled_programs(request):
    """Compile as the module asks for. Drop all programs when they fill the memory, as they would in a whole run."""
    computes = AS_USERS or getattr(request.module, "COMPUTES", False)
    if computes == jax.config.values["jax_disable_most_optimizations"] or psutil.Process().memory_info().rss > MEMORY:
        compile_for_speed(computes)


@pytest.fixture
def computes():
    """Compile a single test for speed."""
    compile_for_speed(True)
    yield
    compile_for_speed(AS_USERS)


@pytest.fixture(autouse=True)
def kept_programs():
    """A command that runs within the process keeps programs. The next test compiles its own again."""
    yield
    os.environ.pop("JAXNBV_PROGRAMS", None)


@pytest.fixture(autouse=True)
def random_numbers_of_its_own(request):
    """Reseed the module's generator, so that a test draws the same numbers whichever tests ran before it."""
    if hasattr(request.module, "RNG"):
        request.module.RNG = np.random.default_rng(0)


@pytest.fixture
def compilations():
    """Names of JAX's compilation events in order, including those of eager operations."""
    events = []

    def listen(event, duration, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            events.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield events
    jax.monitoring.unregister_event_duration_listener(listen)


@pytest.fixture
def x64():
    """Double precision for one test, to compare with float64 oracles."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="session")
def shared():
    """The maintainers' folder of reference numbers and meshes, which users do not have."""
    if not SHARED.is_dir():
        pytest.skip("the maintainers' reference data is not beside this checkout")
    return SHARED
