"""Locks of files between processes; the system releases them at the end of a process, however it
comes."""

from __future__ import annotations

import errno
import sys
from typing import IO

#: Windows keeps others from reading the bytes that are locked, so one far behind the text is.
FAR = 1 << 30


def try_lock(file: IO[bytes], byte: int | None = None) -> bool:
    """Lock a file; False where another process holds it.

    Parameters
    ----------
    file : file object
        Open for writing; the lock ends with it.
    byte : int, optional
        Which byte of it, before :data:`FAR`; it need not be there. By default all of it.

    Raises
    ------
    OSError
        On a disk that has no locks.
    """
    try:
        if sys.platform == "win32":
            import msvcrt

            file.seek(FAR if byte is None else byte)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            now = fcntl.LOCK_EX | fcntl.LOCK_NB
            if byte is None:
                fcntl.flock(file, now)
            else:
                fcntl.lockf(file, now, 1, byte)
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES, errno.EAGAIN, errno.EDEADLK):
            return False
        raise
    return True
