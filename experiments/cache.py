"""Compiled programs are kept on disk: the next run of the same code starts training at once."""

import os
from pathlib import Path

import jax

MOST_BYTES = 1 << 30
"""Bytes that stay in the folder between commands; a default run writes about 50 MB."""
LEAST_SECONDS = 0.2
"""Programs that compile sooner are not worth a file."""


def keep_programs(wanted: bool = True) -> Path | None:
    """Switch JAX's compilation cache on, in ``$XDG_CACHE_HOME/essjax/programs``; call it before anything is compiled.

    A folder that was chosen already (``JAX_COMPILATION_CACHE_DIR``) is used as it is, and left to whoever chose it;
    ``JAX_ENABLE_COMPILATION_CACHE=0`` stays off.

    Args:
      wanted: False switches the cache off.

    Returns:
      The folder that is used, or None: it was not wanted, or cannot be written.
    """
    if not wanted:
        jax.config.update("jax_enable_compilation_cache", False)
    if not jax.config.jax_enable_compilation_cache:
        return None
    chosen = jax.config.jax_compilation_cache_dir
    if chosen:
        return Path(chosen)
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "essjax" / "programs"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        shrink(folder, MOST_BYTES)
    except OSError:
        return None
    if not os.access(folder, os.W_OK):
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", LEAST_SECONDS)
    return folder


def shrink(folder: Path, most_bytes: int) -> None:
    """Remove the files of ``folder`` that were not used for longest until the others take at most ``most_bytes``.

    JAX would do it itself, but only with one more package (filelock).
    """
    files = [(path, path.stat()) for path in folder.iterdir() if path.is_file()]
    kept = 0
    for path, stat in sorted(files, key=lambda item: -max(item[1].st_atime, item[1].st_mtime)):
        kept += stat.st_size
        if kept > most_bytes:
            path.unlink(missing_ok=True)  # another command may have been faster
