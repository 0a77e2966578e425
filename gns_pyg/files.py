"""Files on disk: whole under their final name or not there, and what one process uses at a time."""

import fcntl
import os
import shutil
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from gns_pyg.errors import ConfigError, StorageError

UNFINISHED = (".part", ".old")  # endings: what will be a file or folder, and the folder that it replaces
REMEDY = "make room or choose another folder, then give the same command again"


def unfinished(path: Path) -> Path:
    """The name under which this process writes what will be `path`: .NAME.HOST.PID.part beside it."""
    return path.with_name(f".{path.name}.{socket.gethostname()}.{os.getpid()}.part")


def clean_stale(path: Path) -> None:
    """Removes what processes of this machine that are gone left unfinished of `path`."""
    prefix = f".{path.name}."
    for found in path.parent.iterdir() if path.parent.is_dir() else ():
        if found.name.startswith(prefix) and found.suffix in UNFINISHED:
            host, _, pid = found.stem.removeprefix(prefix).rpartition(".")
            if host == socket.gethostname() and not (pid.isdigit() and _runs(int(pid))):
                if found.suffix == ".old" and not path.exists():  # the process went between its two renames
                    os.replace(found, path)
                remove(found)


def remove(path: Path) -> None:
    """Removes a file or a folder, if it is there and can be removed."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


@contextmanager
def whole(path: str | Path) -> Iterator[Path]:
    """Yields a temporary name beside `path` for a file or a folder; without an error it is renamed to `path` in the
    end and replaces what was there, else it is removed.

    Raises:
        StorageError: if it cannot be written; what was at `path` stays.
    """
    path = Path(path)
    temporary = unfinished(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        clean_stale(path)
        remove(temporary)
        yield temporary
        old = temporary.with_suffix(".old")
        if path.is_dir():  # renamed, not emptied: it is whole or not there
            os.replace(path, old)
        os.replace(temporary, path)
        remove(old)
    except OSError as error:
        raise StorageError(path, str(error), "a folder that can be written to", REMEDY) from None
    finally:
        remove(temporary)


@contextmanager
def held(folder: Path, item: int | None = None, waiting: Callable[[], None] | None = None) -> Iterator[None]:
    """Keeps a run folder to this process; the lock ends with the process, however it ends.

    Args:
        folder: a run folder.
        item: keeps only this one of the numbered things in it.
        waiting: called if another process holds it, which then is waited for.

    Raises:
        ConfigError: if another process holds it.
        StorageError: if it cannot be written to, or its file system knows no locks.
    """
    part = (0, 0) if item is None else (1, item)  # length and start of the bytes that are locked; length 0: all
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / ".lock").open("w")
    except OSError as error:
        raise StorageError(folder, str(error), "a folder that can be written to", REMEDY) from None
    with file:
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, *part)
        except (BlockingIOError, PermissionError):
            if waiting is None:
                remedy = "wait until it ends, or choose another folder with hydra.run.dir=..."
                raise ConfigError("folder", f"{folder}: in use by another process", "a run folder", remedy) from None
            waiting()
            fcntl.lockf(file, fcntl.LOCK_EX, *part)
        except OSError as error:
            raise StorageError(folder, str(error), "a file system with locks", "choose another folder") from None
        yield


def _runs(pid: int) -> bool:
    """Whether there is such a process; one that has ended and that nobody has waited for yet is none."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    stat = Path(f"/proc/{pid}/stat")
    with suppress(OSError):
        return stat.read_text().rpartition(")")[2].split()[0] != "Z"
    return True
