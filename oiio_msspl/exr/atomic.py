# SPDX-License-Identifier: Apache-2.0
"""Writing files atomically: a file appears whole or not at all."""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from oiio_msspl.errors import InputError, MssplError


def check_target(path: str | Path, *, overwrite: bool) -> Path:
    """Check that a file can be written at ``path``, before any work is done.

    Returns:
        ``path`` as a ``Path``.

    Raises:
        InputError: it exists and may not be overwritten, it is a folder, or its folder is missing or read-only.
    """
    path = Path(path)
    check_encodable(path)
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file in it")
    if os.path.lexists(path) and not overwrite:
        raise InputError(f"{path}: exists; pass --overwrite to replace it")
    check_folder(path)
    return path


def check_encodable(path: Path) -> None:
    """Raise InputError if a path is not UTF-8: OpenImageIO could not open it."""
    try:
        str(path).encode("utf-8")
    except UnicodeEncodeError as error:
        raise InputError(f"{path}: the path is not UTF-8, which OpenImageIO can't open; rename it") from error


def check_folder(path: Path) -> None:
    """Check the folder of ``path``.

    Raises:
        InputError: it is missing or read-only.
    """
    folder = path.parent
    if not folder.is_dir():
        raise InputError(f"{path}: the folder {folder} does not exist; create it first")
    if not os.access(folder, os.W_OK):
        raise InputError(f"{path}: the folder {folder} is not writable")


@contextmanager
def replacing(path: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Give the ``with`` block a temporary file, and rename it to ``path`` when the block ends.

    If the block raises, the temporary file is deleted and ``path`` stays as it was. If ``path`` is a link, the file
    that it points to is replaced. A replaced file keeps its permissions.

    Args:
        path: the file to write.
        overwrite: replace an existing file.

    Yields:
        The path of the temporary file, in the same folder.

    Raises:
        InputError: without ``overwrite``, a file has appeared at ``path`` meanwhile.
        MssplError: the file system refused, e.g. because the disk is full; ``path`` is as it was.
    """
    target = Path(os.path.realpath(path))
    # remove_leftovers finds the file by this form of its name. Processes on two machines may have the same id.
    unique = f"{os.getpid()}{secrets.randbelow(10**9):09d}"
    temporary = target.with_name(f".{target.stem}.{unique}.tmp{target.suffix}")
    try:
        yield temporary
        # The pixels must be on the disk before the rename: a crash must not leave half a file under the final name.
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
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
    finally:
        temporary.unlink(missing_ok=True)


def remove_leftovers(targets: Iterable[Path]) -> None:
    """Delete the temporary files that killed runs left beside these files.

    If another process is writing one of them at this moment, that process fails with a message.
    """
    wanted = {Path(os.path.realpath(target)) if target.is_symlink() else target for target in targets}
    for folder in {target.parent for target in wanted}:
        for name in os.listdir(folder) if folder.is_dir() else ():
            match = re.fullmatch(r"\.(.+)\.\d+\.tmp(\.\w+)", name)
            if match and folder / (match[1] + match[2]) in wanted:
                with suppress(OSError):
                    (folder / name).unlink()


def _name_if_free(temporary: Path, target: Path) -> None:
    """Rename a file in one step that fails if the target exists: two jobs must not overwrite each other."""
    try:
        os.link(temporary, target)
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        if target.exists():
            raise FileExistsError from None
        os.replace(temporary, target)
