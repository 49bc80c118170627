"""A disk that fails: a stand-in for the module `os` in `rlctl.storage.files`, which counts operations."""

import errno
import os
import shutil
import signal

COUNTED = ("open", "write", "fsync", "ftruncate", "replace", "rename", "unlink", "rmdir", "makedirs")
"""Operations that change what is on the disk, or make sure of it."""
_NEED_ROOM = ("open", "write", "fsync", "ftruncate", "makedirs")


class FaultyOs:
    """Hands everything on to `os`, and fails at the operation number `at`.

    `fault` is `kill`, `half` (killed after half of a write, or after the operation), `power` (killed, and what was
    written and not flushed to the disk is lost), `short` (half of a write is taken), or the name of an error such as
    `ENOSPC`; None lets everything pass. `lasting` errors go on: a full disk then still removes and renames, and other
    broken disks do nothing any more.
    """

    def __init__(self, log, fault=None, at=0, lasting=False):
        self.count = 0
        self._log = log
        self._fault = fault
        self._at = at
        self._lasting = lasting
        self._unsynced = {}
        """inode -> descriptor of ours, and how much of the file is on the disk for sure."""

    def __getattr__(self, name):
        original = getattr(os, name)
        if name not in COUNTED:
            return original

        def operation(*arguments, **options):
            self.count += 1
            self._log(f"operation {self.count} {name} {arguments[0]}")
            self._record_evaluation(name, *arguments)
            return self._operate(name, original, arguments, options)

        return operation

    def _record_evaluation(self, name, first, *_):
        if name not in ("write", "fsync"):
            return
        status = os.fstat(first)
        if name == "fsync" and not self._hit(name) and status.st_ino in self._unsynced:
            os.close(self._unsynced.pop(status.st_ino)[0])
        if name == "write" and status.st_ino not in self._unsynced:
            self._unsynced[status.st_ino] = (os.dup(first), status.st_size)

    def _operate(self, name, original, arguments, options):
        if not self._hit(name):
            return original(*arguments, **options)
        self._log(f"fault {name} {arguments[0]}")
        if self._fault == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if self._fault == "power":
            for descriptor, size in self._unsynced.values():
                os.ftruncate(descriptor, size)
            os.kill(os.getpid(), signal.SIGKILL)
        if self._fault == "half":
            self._half(name, original, arguments, options)
            os.kill(os.getpid(), signal.SIGKILL)
        if self._fault == "short":
            return self._half(name, original, arguments, options)
        if name == "write":
            self._half(name, original, arguments, options)
        number = getattr(errno, self._fault)
        raise OSError(number, os.strerror(number), *(str(each) for each in arguments[:1] if name != "write"))

    def _hit(self, name):
        if self._fault is None or self.count < self._at or not (self._lasting or self.count == self._at):
            return False
        return not (self._lasting and self._fault == "ENOSPC" and name not in _NEED_ROOM)

    def _half(self, name, original, arguments, options):
        if name != "write":
            return original(*arguments, **options)
        descriptor, content = arguments
        return original(descriptor, content[: max(1, len(content) // 2)])


class FaultyShutil:
    """Removes trees in as many operations as it takes."""

    def __init__(self, faulty: FaultyOs):
        self._os = faulty

    def __getattr__(self, name):
        return getattr(shutil, name)

    def rmtree(self, folder, ignore_errors=False):
        try:
            for entry in os.scandir(folder):
                if entry.is_dir(follow_symlinks=False):
                    self.rmtree(entry.path, ignore_errors)
                else:
                    self._remove(self._os.unlink, entry.path, ignore_errors)
        except FileNotFoundError:
            if not ignore_errors:
                raise
            return
        self._remove(self._os.rmdir, folder, ignore_errors)

    def _remove(self, remove, path, ignore_errors):
        try:
            remove(path)
        except OSError:
            if not ignore_errors:
                raise
