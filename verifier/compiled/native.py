"""Machine code of LLVM assembly, kept on disk for the next run.

The object files lie in the user's cache directory, or in CLOSEDLAP_CACHE; where that is
empty ("") or cannot be written, programs are compiled anew in every run. A file's name is a hash
of the assembly, of LLVM's version and of the processor, so that it needs no invalidation.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import sys
import threading
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

#: Names another cache directory, or none.
CACHE_VARIABLE = "CLOSEDLAP_CACHE"


def cache_directory() -> Path | None:
    """Return where object files are kept; None: nowhere."""
    given = os.environ.get(CACHE_VARIABLE)
    if given is not None:
        return Path(given) if given else None
    try:
        home = Path.home()
    except RuntimeError:
        return None
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
    return base / "closedlap" / "kernels"


class Processor:
    """LLVM, set up for the processor that it runs on."""

    def __init__(self) -> None:
        import llvmlite  # noqa: PLC0415 (a large library)
        from llvmlite import binding  # noqa: PLC0415

        binding.initialize_native_target()
        binding.initialize_native_asmprinter()
        self._llvm = binding
        name, features = binding.get_host_cpu_name(), binding.get_host_cpu_features()
        # Of LLVM's effort 0 to 3; its optimiser is not run at all, a trace leaves it nothing.
        machine = binding.Target.from_default_triple().create_target_machine(
            cpu=name, features=features.flatten(), opt=2
        )
        self._machine = machine
        self._engine = binding.create_mcjit_compiler(binding.parse_assembly(""), machine)
        self.lanes = 8 if features.get("avx512f") else 4
        version = ".".join(map(str, binding.llvm_version_info))
        self._identity = "\n".join(
            [llvmlite.__version__, version, machine.triple, name, features.flatten()]
        )

        self._loaded: dict[str, Callable[..., None]] = {}

    def function(self, assembly: str, parameters: int) -> Callable[..., None]:
        """Return the function ``kernel`` of the assembly, with so many integer parameters."""
        key = hashlib.sha256(f"{self._identity}\n{assembly}".encode()).hexdigest()
        if key not in self._loaded:
            name = f"kernel_{key}"
            code = self._object(key, assembly.replace("@kernel(", f"@{name}(", 1))
            self._engine.add_object_file(self._llvm.ObjectFileRef.from_data(code))
            self._engine.finalize_object()
            address = self._engine.get_function_address(name)
            self._loaded[key] = ctypes.CFUNCTYPE(None, *[ctypes.c_ssize_t] * parameters)(address)
        return self._loaded[key]

    def _object(self, key: str, assembly: str) -> bytes:
        directory = cache_directory()
        if directory is not None:
            kept = _read(directory / f"{key}.o")
            if kept is not None:
                return kept
        module = self._llvm.parse_assembly(assembly)
        module.triple = self._machine.triple
        module.data_layout = str(self._machine.target_data)
        code = self._machine.emit_object(module)
        if directory is not None:
            _write(directory / f"{key}.o", code)
        return code


@lru_cache(maxsize=1)
def processor() -> Processor:
    """Return the processor; sets LLVM up at first."""
    return Processor()


def _read(path: Path) -> bytes | None:
    """Return an object file if it is whole: its last 32 bytes are the hash of the others."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    code, digest = data[:-32], data[-32:]
    return code if hashlib.sha256(code).digest() == digest else None


def _write(path: Path, code: bytes) -> None:
    """Write an object file whole or, where that is not possible, not at all."""
    part = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(code + hashlib.sha256(code).digest())
        part.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            part.unlink()
