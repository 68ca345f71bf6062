# SPDX-License-Identifier: Apache-2.0
"""Files that appear whole or not at all."""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from oiio_msspl.errors import InputError, MssplError


def check_target(path: str | Path, *, overwrite: bool) -> Path:
    """Fail before any work is done if a file could not be put here.

    Raises:
        InputError: it exists and may not be overwritten, or its folder is missing or read-only.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file in it")
    if os.path.lexists(path) and not overwrite:
        raise InputError(f"{path}: exists; pass --overwrite to replace it")
    check_folder(path)
    return path


def check_folder(path: Path) -> None:
    """Raise InputError if the folder of ``path`` is missing or read-only."""
    folder = path.parent
    if not folder.is_dir():
        raise InputError(f"{path}: the folder {folder} does not exist; create it first")
    if not os.access(folder, os.W_OK):
        raise InputError(f"{path}: the folder {folder} is not writable")


@contextmanager
def replacing(path: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary file beside ``path`` that takes its place when the block ends well, and vanishes otherwise.

    A link keeps pointing where it points, and a file that is replaced keeps its permissions.

    Raises:
        InputError: without ``overwrite``, somebody else has put a file there meanwhile.
        MssplError: the file system refused (disk full, permissions); ``path`` is as it was.
    """
    target = Path(os.path.realpath(path))
    # As remove_leftovers knows it. Processes on two machines may have one number.
    unique = f"{os.getpid()}{secrets.randbelow(10**9):09d}"
    temporary = target.with_name(f".{target.stem}.{unique}.tmp{target.suffix}")
    try:
        yield temporary
        # On the disk before it gets its name: a crash must not leave a whole name on half a file.
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

    Should another process be writing one of them at this moment, it fails and says so.
    """
    wanted = {Path(os.path.realpath(target)) if target.is_symlink() else target for target in targets}
    for folder in {target.parent for target in wanted}:
        for name in os.listdir(folder) if folder.is_dir() else ():
            match = re.fullmatch(r"\.(.+)\.\d+\.tmp(\.\w+)", name)
            if match and folder / (match[1] + match[2]) in wanted:
                with suppress(OSError):
                    (folder / name).unlink()


def _name_if_free(temporary: Path, target: Path) -> None:
    """Give a file its name in one step that fails if there is one: two jobs must not overwrite each other."""
    try:
        os.link(temporary, target)
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        if target.exists():
            raise FileExistsError from None
        os.replace(temporary, target)
