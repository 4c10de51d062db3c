"""What a tool may not do outside its scratch folder, kept by Linux's Landlock.

A process may lay rules upon itself that it and all that it starts can never shed, without being
root. From version 6 of the interface (Linux 6.12) they can forbid sending signals to
processes that are not under the same rules: a tool cannot kill its supervisor, nor a script
that says ``killall python`` the harness. From version 3 on (Linux 6.2) they can forbid every
change to files outside given folders.

Numbers and structures: linux/landlock.h.
"""

from __future__ import annotations

import ctypes
import os
import struct
import sys
from collections.abc import Sequence
from contextlib import suppress

_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_VERSION_FLAG = 1
_RULE_PATH_BENEATH = 1
_SCOPE_SIGNAL = 1 << 1
_PR_SET_NO_NEW_PRIVS = 38
_CAP_SYS_ADMIN = 21
#: WRITE_FILE, REMOVE_DIR, REMOVE_FILE, seven MAKE_*, REFER (interface 2), TRUNCATE (interface 3).
_WRITE_FILE, _TRUNCATE = 1 << 1, 1 << 14
_CHANGES = _WRITE_FILE | sum(1 << bit for bit in range(4, 15))
_WRITES_FROM, _SIGNALS_FROM = 3, 6

#: What every program may write to, where it is there.
_DEVICES = (
    *("/dev/null", "/dev/zero", "/dev/full", "/dev/tty", "/dev/random", "/dev/urandom"),
    *("/dev/ptmx", "/dev/kfd", "/dev/nvidiactl", "/dev/nvidia-uvm", "/dev/nvidia-uvm-tools"),
    *(f"/dev/nvidia{i}" for i in range(16)),
)
#: Folders of devices and of shared memory (semaphores lie there).
_FOLDERS = ("/dev/shm", "/dev/pts", "/dev/dri")


def _library() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def interface() -> int:
    """Return the version of the kernel's interface; 0 where there is none."""
    if not sys.platform.startswith("linux"):
        return 0
    with suppress(OSError, AttributeError):
        return max(0, _library().syscall(_CREATE_RULESET, None, 0, _VERSION_FLAG))
    return 0


def can_forbid_writes() -> bool:
    """Whether changes to files outside a folder can be forbidden."""
    return interface() >= _WRITES_FROM


def can_forbid_signals(no_new_privileges: bool) -> bool:
    """Whether signals to others can be forbidden.

    no_new_privileges: whether programs may lose their setuid bit for it; root's need not.
    """
    return interface() >= _SIGNALS_FROM and (no_new_privileges or _is_admin())


def _is_admin() -> bool:
    """Whether this process has CAP_SYS_ADMIN, as root has."""
    with suppress(OSError, ValueError), open("/proc/self/status", encoding="ascii") as file:  # noqa: PTH123
        for line in file:
            if line.startswith("CapEff:"):
                return bool(int(line.split()[1], 16) >> _CAP_SYS_ADMIN & 1)
    return False


class Rules:
    """Rules that a process can lay upon itself; close them when it has.

    folder: where alone files may be changed; None: anywhere. signals: whether
    signals to processes outside are forbidden. Raises OSError where the kernel can't.
    """

    def __init__(self, folder: str | None, signals: bool) -> None:
        self._library = _library()
        self.signals = signals
        handled = _CHANGES if folder is not None else 0
        scoped = _SCOPE_SIGNAL if signals else 0
        attributes = struct.pack("<QQQ", handled, 0, scoped)
        # An older kernel knows the first field or two only.
        size = len(attributes) if signals else 8
        self._no_new_privileges = not _is_admin()
        self._fd = self._call(_CREATE_RULESET, attributes, ctypes.c_size_t(size), 0)
        try:
            if folder is not None:
                self._allow([folder, *_FOLDERS], _CHANGES)
                self._allow(_DEVICES, _WRITE_FILE | _TRUNCATE)
        except OSError:
            self.close()
            raise

    def _allow(self, paths: Sequence[str], access: int) -> None:
        for path in paths:
            try:
                fd = os.open(path, os.O_PATH | os.O_CLOEXEC)
            except OSError:  # not on this machine
                continue
            try:
                self._call(
                    _ADD_RULE, self._fd, _RULE_PATH_BENEATH, struct.pack("<Qi", access, fd), 0
                )
            finally:
                os.close(fd)

    def _call(self, number: int, *arguments: object) -> int:
        result: int = self._library.syscall(number, *arguments)
        if result < 0:
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code), "landlock")
        return result

    def enforce(self) -> None:
        """Lay the rules upon this process, for ever."""
        if self._no_new_privileges:
            self._library.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
        self._call(_RESTRICT_SELF, self._fd, 0)

    def close(self) -> None:
        """Forget the rules; processes that laid them upon themselves keep them."""
        os.close(self._fd)
