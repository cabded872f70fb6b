"""Settings of the whole suite, and the fixtures that every test may use."""

import gc
import os
import shutil
import tempfile
from importlib.metadata import version

# Before JAX starts: the suite spends its time on compiling. LLVM without optimisation compiles in two thirds of it, and
# without the emitters that set up an MLIR context for every fusion that halves again (a flag of some versions; others
# end at a flag that they do not know). XLA's own passes stay on. Set XLA_FLAGS (also to nothing) to test what users
# run; a test of speed must not rely on it.
_FLAGS = ["--xla_backend_optimization_level=0", "--xla_llvm_disable_expensive_passes=true"]
if version("jaxlib").startswith("0.10."):
    _FLAGS.append("--xla_cpu_use_fusion_emitters=false")
os.environ.setdefault("XLA_FLAGS", " ".join(_FLAGS))
# Without a GPU Triton kernels are tested in its interpreter; Triton reads this when it is imported.
if shutil.which("nvidia-smi") is None:
    os.environ.setdefault("TRITON_INTERPRET", "1")

import hypothesis  # noqa: E402
import jax  # noqa: E402
import pytest  # noqa: E402

from essjax.scenes import render  # noqa: E402

render.CPU_CHUNK = 4096  # images are small here: filling up a chunk of the usual size would cost more than they do
PROGRAMS = 400
"""A worker that holds more of them at the end of a file forgets all: they would stay until it ends, 7 GB of them."""

hypothesis.settings.register_profile("default", deadline=None, max_examples=15, print_blob=True)
hypothesis.settings.register_profile("ci", parent=hypothesis.settings.get_profile("default"), derandomize=True)
hypothesis.settings.load_profile("ci" if os.environ.get("CI") else "default")


CACHE = "ESSJAX_TESTS_CACHE"


def pytest_configure(config):
    """One compilation cache for all workers, which inherit the environment; nothing outlives the run."""
    if not hasattr(config, "workerinput"):
        config.stash[_FOLDER] = tempfile.TemporaryDirectory(prefix="essjax-tests-", ignore_cleanup_errors=True)
        os.environ[CACHE] = config.stash[_FOLDER].name


def pytest_unconfigure(config):
    """Remove it."""
    if _FOLDER in config.stash:
        config.stash[_FOLDER].cleanup()


_FOLDER = pytest.StashKey[tempfile.TemporaryDirectory]()


@pytest.fixture(scope="session", autouse=True)
def compilation_cache():
    """Programs compiled twice in one run (new closures, other files, subprocesses) are compiled once."""
    os.environ["JAX_COMPILATION_CACHE_DIR"] = os.environ[CACHE]  # subprocesses
    jax.config.update("jax_compilation_cache_dir", os.environ[CACHE])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    yield
    jax.config.update("jax_compilation_cache_dir", None)
    os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)


@pytest.fixture(scope="module", autouse=True)
def bounded_memory():
    """Forget compiled programs between files, before they are too many."""
    yield
    if len(jax.devices()[0].client.live_executables()) > PROGRAMS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture
def strict_numerics():
    """No silent dtype or rank promotion; for kernels and losses (optax needs promotion, so never for a train step)."""
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        yield
