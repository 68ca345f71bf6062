# SPDX-License-Identifier: Apache-2.0
"""Write files atomically: a file appears whole or not at all.

The file is written into a hidden folder beside the target, ``.msspl-MACHINE-PROCESS-RANDOM``. MACHINE is a hash of the
machine on which the process PROCESS runs. So a later run can tell whether the process of a folder that it meets still
lives.
"""

from __future__ import annotations

import os
import re
import shutil
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from hashlib import sha256
from pathlib import Path

from oiio_msspl.errors import InputError, MssplError

#: Seconds after which the folders of a process that can't be looked up count as abandoned. A file is written in much
#: less, and the folder of a job is touched with every frame that is rendered.
_ABANDONED = 24 * 3600


def check_target(path: str | Path, *, overwrite: bool) -> Path:
    """Check that a file can be written at ``path``, before any work is done, and return it as a ``Path``."""
    path = Path(path)
    check_encodable(path)
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file in it")
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: is no ordinary file; name another one")
    if os.path.lexists(path) and not overwrite:
        raise InputError(f"{path}: exists; pass --overwrite to replace it")
    # Renaming would replace a write-protected file all the same. Somebody protected it on purpose.
    if path.exists() and not (path.stat().st_mode & 0o222 and os.access(path, os.W_OK)):
        raise InputError(f"{path}: is write-protected; make it writable or name another file")
    check_folder(path)
    return path


def check_separate(reads: Iterable[Path], writes: Iterable[Path]) -> None:
    """Check that a run reads no file that it writes, and writes no file under two names.

    Links and hard links are followed. ``--overwrite`` makes no difference: the caller wants both files.
    """
    read = {_identity(path) for path in reads}
    written: dict[object, Path] = {}
    for path in writes:
        identity = _identity(path)
        if identity in read:
            raise InputError(f"{path}: is one of the inputs; write the result elsewhere")
        if identity in written:
            raise InputError(f"{path}: is the same file as {written[identity]}, which is also written; name another")
        written[identity] = path


def _identity(path: Path) -> object:
    """Return a value that is equal for all names of a file: device and inode, or the full path of a missing file."""
    try:
        status = path.stat()
    except OSError:
        return os.path.normcase(os.path.realpath(path))
    return status.st_dev, status.st_ino


def check_encodable(path: Path) -> None:
    """Raise InputError if a path is not UTF-8: OpenImageIO can't open it."""
    try:
        str(path).encode("utf-8")
    except UnicodeEncodeError as error:
        raise InputError(f"{path}: the path is not UTF-8, which OpenImageIO can't open; rename it") from error


def check_folder(path: Path, *, writable: bool = True) -> None:
    """Raise InputError if the folder of ``path``, or of the file that a link points to, is missing or read-only."""
    folder = Path(os.path.realpath(path)).parent if path.is_symlink() else path.parent
    if not folder.is_dir():
        problem = "is a file; name another one" if folder.exists() else "does not exist; create it first"
        raise InputError(f"{path}: the folder {folder} {problem}")
    if writable and not os.access(folder, os.W_OK):
        raise InputError(f"{path}: the folder {folder} is not writable")


def make_folder(folder: Path, *, new: bool = False) -> None:
    """Make a folder if it does not exist, or raise InputError, also if it exists but has to be ``new``."""
    try:
        folder.mkdir(exist_ok=not new)
    except OSError as error:
        raise InputError(f"{folder}: the folder can't be made ({error.strerror})") from error


@contextmanager
def replacing(
    path: Path, *, overwrite: bool = False, before_rename: Callable[[], object] | None = None
) -> Iterator[Path]:
    """Give the ``with`` block a temporary file, and rename it to ``path`` when the block ends.

    The temporary file has the name of ``path``, in a hidden folder beside it. If the block raises, it is deleted, and
    ``path`` stays as it was; so too if ``before_rename`` raises, which is called when the file is complete. If ``path``
    is a link, the file that it points to is replaced. A file that exists is only replaced with ``overwrite``, and keeps
    its permissions.

    Raises:
        InputError: without ``overwrite``, a file has appeared at ``path`` meanwhile.
        MssplError: the file system refused, or the block raised OSError; ``path`` is as it was.
    """
    target = Path(os.path.realpath(path))
    try:
        with temporary_folder(target.parent) as folder:
            temporary = Path(folder, path.name)
            yield temporary
            # The pixels must be on the disk before the rename: a crash must not leave half a file under the final name.
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
            if before_rename is not None:
                before_rename()
            if overwrite:
                if target.exists():
                    os.chmod(temporary, target.stat().st_mode & 0o7777)
                os.replace(temporary, target)
            else:
                _name_if_free(temporary, target)
    except FileExistsError as error:
        raise InputError(f"{path}: appeared while this was computed; pass --overwrite to replace it") from error
    except OSError as error:
        raise MssplError(f"{path}: can't be written ({error.strerror or error}); the target is as it was") from error


def temporary_folder(folder: Path) -> tempfile.TemporaryDirectory[str]:
    """Make a hidden folder ``.msspl-MACHINE-PROCESS-RANDOM``, deleted when its ``with`` block ends (or OSError)."""
    prefix = f".msspl-{_machine()}-{os.getpid()}-"
    return tempfile.TemporaryDirectory(prefix=prefix, dir=folder.absolute(), ignore_cleanup_errors=True)


def remove_leftovers(targets: Iterable[Path]) -> None:
    """Delete the temporary folders that killed processes left beside these files.

    Those of living processes stay. A process on another machine can't be looked up, so its folder stays for a day.
    """
    for folder in {Path(os.path.realpath(target)).parent for target in targets}:
        with suppress(OSError):
            for name in os.listdir(folder):
                match = re.fullmatch(r"\.msspl-([0-9a-f]{8})-(\d+)-[^.]+", name)
                if match and _is_abandoned(folder / name, match[1], int(match[2])):
                    shutil.rmtree(folder / name, ignore_errors=True)


@lru_cache(maxsize=1)
def _machine() -> str:
    """Return a hash of this machine or container since its start: process numbers have a meaning only there."""
    # Containers may share the name of a machine, but not its processes.
    names = [socket.gethostname()]
    with suppress(OSError):
        names += [Path("/proc/sys/kernel/random/boot_id").read_text(), os.readlink("/proc/self/ns/pid")]
    return sha256(os.fsencode(" ".join(names))).hexdigest()[:8]


def _is_abandoned(temporary: Path, machine: str, process: int) -> bool:
    # On Windows, os.kill would end the process.
    with suppress(OSError, OverflowError):
        if machine == _machine() and sys.platform != "win32":
            try:
                os.kill(process, 0)
            except ProcessLookupError:
                return True
        else:  # the clocks of two machines may differ, but not by a day
            return time.time() - temporary.stat().st_mtime > _ABANDONED
    return False


def _name_if_free(temporary: Path, target: Path) -> None:
    """Rename a file unless its target exists, so that two jobs don't overwrite each other."""
    try:
        os.link(temporary, target)
    except OSError:  # without hard links, two jobs that end in the same moment may overwrite each other
        if os.path.lexists(target):
            raise FileExistsError from None
        os.replace(temporary, target)
