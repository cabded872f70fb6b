"""Files that are whole or not there, and folders that one command writes at a time."""

import contextlib
import datetime
import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows: nothing is locked
    fcntl = None

LOCK = ".lock"
"""Name of the file in a folder that is being written; its content informs, ``flock`` decides."""
_TEMPORARY = ".essjax.tmp"


@contextlib.contextmanager
def naming(path: str | os.PathLike) -> Iterator[None]:
    """Let errors of the system that name no file name ``path``: ``write`` notices a full disk, and forgets where."""
    try:
        yield
    except OSError as error:
        if error.filename is not None or error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


@contextlib.contextmanager
def atomic(path: str | os.PathLike) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that replaces it on success and is removed on failure.

    It is another one in every thread and process: two that write the same file do not tear it.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_native_id()}{_TEMPORARY}")
    try:
        with naming(path):
            yield temporary
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def only_writer(folder: str | os.PathLike) -> Iterator[None]:
    """Keep other commands out of ``folder`` while it is entered; it is made, and gone again if nothing was written.

    What a killed command left half-written in it is removed. An output of several shards has a folder and so a lock
    for each. Locks end with their process, however it ends; file systems without locks are not locked.

    Raises:
      ValueError: another command writes there, or it is no folder.
      OSError: it cannot be made or written.
    """
    folder = Path(folder)
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not there.is_dir():
        raise ValueError(f"{folder}: expected a folder, but {there} is a file. Choose another one.")
    folder.mkdir(parents=True, exist_ok=True)
    try:
        file = _locked(folder / LOCK)
        try:
            for leftover in folder.rglob(f".*{_TEMPORARY}"):
                leftover.unlink(missing_ok=True)
            yield
        finally:
            (folder / LOCK).unlink(missing_ok=True)  # while it is held: nobody else can have it by now
            os.close(file)
    finally:
        with contextlib.suppress(OSError):
            for path in made:
                path.rmdir()  # fails as soon as one holds something


def _locked(path: Path) -> int:
    """Return a descriptor of ``path``, which holds its lock.

    Raises:
      ValueError: another one does.
    """
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            owner = os.read(file, 200).decode(errors="replace").strip() or "which has just begun"
            os.close(file)
            raise ValueError(
                f"{path.parent}: another command writes into this folder ({owner}). Wait until it has ended, or choose "
                "another folder."
            ) from error
        except OSError:  # a file system without locks
            pass
        try:
            same = os.path.samestat(os.fstat(file), os.stat(path))
        except FileNotFoundError:
            same = False
        if same:
            break
        os.close(file)  # its owner had removed it meanwhile: what we hold is nobody's lock any more
    with contextlib.suppress(OSError):  # a full disk
        os.truncate(file, 0)
        now = datetime.datetime.now().astimezone().isoformat(" ", "seconds")
        os.write(file, f"process {os.getpid()} on {socket.gethostname()} since {now}\n".encode())
    return file
