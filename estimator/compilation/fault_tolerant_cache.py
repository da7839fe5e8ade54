"""Cache of compiled code on disk: damaged files are compiled anew, and an unwritable disk is no error.

It replaces Numba's own cache, which raises for damaged files and for unwritable folders, and does not detect a flipped
bit.
"""

from __future__ import annotations

import gc
import hashlib
import os
import pickle
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numba
from llvmlite import binding

from estimator.compilation.numba_internals import CompileResult, _Cache, dumps, event, rtsys
from estimator.support.file_io import write_atomically


@cache
def cache_folder() -> Path | None:
    """Folder of generated and compiled code; None, with one RuntimeWarning, if no folder is writable.

    The candidates are ``NUMBA_CACHE_DIR`` if it is set, else ``__pycache__`` beside this file; then the user's cache
    folder.
    """
    for candidate in _candidate_folders():
        try:
            candidate.mkdir(parents=True, exist_ok=True)
            handle, probe = tempfile.mkstemp(dir=candidate)
            os.close(handle)
            os.unlink(probe)
        except OSError:
            continue
        return candidate
    warnings.warn(
        "no folder can be written for compiled code, so it is compiled anew in every process; set NUMBA_CACHE_DIR to a "
        "folder that can",
        RuntimeWarning,
        stacklevel=2,
    )
    return None


def _candidate_folders() -> list[Path]:
    import platformdirs

    requested = os.environ.get("NUMBA_CACHE_DIR")
    places = [Path(requested).absolute()] if requested else [Path(__file__).parent / "__pycache__"]
    try:
        user_folder = Path(platformdirs.user_cache_dir("duffing-env"))
    except RuntimeError:  # a user without a home
        return places
    return [*places, user_folder] if user_folder.is_absolute() else places


def write_cached(path: Path, content: bytes) -> None:
    """Write a file atomically; with a full disk the next process compiles again."""
    with suppress(OSError):
        write_atomically(path, content)


class CompilationNotice(event.Listener):
    """A notice on stderr, once per process, if compilation takes longer than `NOTICE_AFTER`.

    Python's garbage collector is off during compilation: it would scan all of Numba's objects again and again, and
    free nothing.

    Args:
        now: clock [s].
        timer: ``timer(seconds, function, arguments)`` calls a function later, as `threading.Timer`.
    """

    #: Time of compilation before the notice [s].
    NOTICE_AFTER = 2.0

    def __init__(
        self, now: Callable[[], float] = time.perf_counter, timer: Callable[..., Any] = threading.Timer
    ) -> None:
        self._now, self._new_timer = now, timer
        self._depth = 0  # called functions are compiled during the caller's compilation
        self._seconds_spent = 0.0
        self._started_at: float | None = None
        self._has_printed = False
        self._timer: Any = None
        self._gc_was_enabled = False

    def on_start(self, event: Any) -> None:
        """Called when the compilation of a function begins."""
        dispatcher = event.data["dispatcher"]
        if self._depth == 0 and not isinstance(dispatcher._cache, DiskCache):
            return  # a function of another package
        self._depth += 1
        if self._depth > 1:
            return
        self._gc_was_enabled = gc.isenabled()
        gc.disable()
        self._started_at = self._now()
        if not self._has_printed:
            rest = max(0.0, self.NOTICE_AFTER - self._seconds_spent)
            self._timer = self._new_timer(rest, self._print_notice, [dispatcher.py_func])
            self._timer.daemon = True
            self._timer.start()

    def on_end(self, event: Any) -> None:
        """Called when the compilation of a function ends or fails."""
        self._depth = max(0, self._depth - 1)
        if self._depth > 0 or self._started_at is None:
            return
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._seconds_spent += self._now() - self._started_at
        self._started_at = None
        if self._gc_was_enabled:
            gc.enable()

    def _print_notice(self, function: Callable[..., Any]) -> None:
        self._has_printed = True
        how_often = "in every process" if cache_folder() is None else "once"
        notice = f"duffing-env is compiling {function.__name__:.17}: seconds to minutes, {how_often}"
        print(notice, file=sys.stderr, flush=True)


@cache
def watch_compilation() -> None:
    """Register a `CompilationNotice` with Numba."""
    event.register("numba:compile", CompilationNotice())


class DiskCache(_Cache):
    """Numba's cache of a function, as one file per signature and processor.

    A file begins with the digest of the sources and the digest of the rest. Another digest of the sources is another
    version, and the function is compiled again in silence; another digest of the rest is damage.

    Args:
        function: the function.
        sources_digest: digest of the sources, 64 hexadecimal digits.
        has_unique_name: whether the qualified name differs between functions of one definition. If not, the closure
            identifies the function; a closure that differs between two processes is compiled in both.
    """

    def __init__(self, function: Callable[..., Any], sources_digest: str, has_unique_name: bool = False) -> None:
        code = function.__code__
        self._name = f"{Path(code.co_filename).stem}.{function.__qualname__}".replace("<", "").replace(">", "")
        self._origin = f"{code.co_filename}:{code.co_firstlineno}:{sys.version_info[:2]}:{numba.__version__}"
        self._closure = () if has_unique_name else function.__closure__ or ()
        self._sources_digest = sources_digest.encode()
        self._enabled = True
        watch_compilation()

    @property
    def cache_path(self) -> str | None:
        """The folder; None if no folder is writable."""
        return None if cache_folder() is None else str(cache_folder())

    def enable(self) -> None:
        """Use the disk."""
        self._enabled = True

    def disable(self) -> None:
        """Leave the disk alone."""
        self._enabled = False

    def flush(self) -> None:
        """Remove the files of all functions of this name."""
        place = cache_folder()
        for path in place.glob(f"{self._name[:100]}-*.compiled") if place is not None else ():
            path.unlink(missing_ok=True)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled function; None if there is no file, or a damaged one."""
        path = self._path(sig, target_context.codegen())
        try:
            content = path.read_bytes() if path is not None else b""
        except OSError:
            return None
        stamp, digest, payload = content[:64], content[64:128], content[128:]
        if path is None or (stamp != self._sources_digest and len(content) > 128):
            return None
        try:
            if hashlib.sha256(payload).hexdigest().encode() != digest:
                raise ValueError("the digest is another")
            called, *reduced = pickle.loads(payload)
            # Loading all of Numba takes long, and is needed only if the code calls its functions.
            rtsys.initialize(target_context)
            if any(binding.address_of_symbol(name) is None for name in called):
                target_context.refresh()
            return CompileResult._rebuild(target_context, *reduced)
        except Exception:  # a pickle may raise anything
            _warn_damaged(str(path.parent))
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Write a compiled function, if it can be cached."""
        path = self._path(sig, data.codegen)
        if path is None or data.lifted or data.library.has_dynamic_globals:
            return
        functions = data.library._final_module.functions
        called = [f.name for f in functions if f.is_declaration and not f.name.startswith("llvm.")]
        payload = dumps((called, *data._reduce()))
        write_cached(path, self._sources_digest + hashlib.sha256(payload).hexdigest().encode() + payload)

    def _path(self, sig: Any, codegen: Any) -> Path | None:
        place = cache_folder() if self._enabled else None
        if place is None:
            return None
        key = hashlib.sha256(f"{self._origin}\n{self._name}\n{sig}\n{codegen.magic_tuple()}".encode())
        key.update(dumps(tuple(cell.cell_contents for cell in self._closure)))
        return place / f"{self._name[:100]}-{key.hexdigest()[:16]}.compiled"


@cache
def _warn_damaged(place: str) -> None:
    """Warn of damage, once per folder and process."""
    warnings.warn(
        f"compiled code in {place} is damaged, and is compiled anew; if this warning returns, delete that folder",
        RuntimeWarning,
        stacklevel=2,
    )
