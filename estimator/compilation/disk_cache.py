"""Compiled code on disk: read by whoever needs it next, made anew where it is damaged, left out where none can be kept.

It stands in place of Numba's own cache, whose index and data files are fatal where they are damaged, which refuses to
work where nothing can be written, and which cannot see a bit that flipped.
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
    """Where generated and compiled code is kept; None, with one RuntimeWarning, where nothing can be written.

    ``NUMBA_CACHE_DIR`` where it is set; else ``__pycache__`` beside this file; else the user's cache folder.
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
    """Write a file in one piece; a full disk only costs the next process the time to make it again."""
    with suppress(OSError):
        write_atomically(path, content)


class CompilationNotice(event.Listener):
    """Watches over compilation: Numba tells when it begins and ends to compile a function.

    What takes longer than `NOTICE_AFTER` says on stderr that it compiles, once in a process. Python's garbage collector
    rests meanwhile: it looks through all that Numba builds, again and again, and finds nothing.

    Args:
        now: the time [s].
        timer: makes what calls a function after so many seconds.
    """

    #: Seconds that the process may spend compiling before it says so.
    NOTICE_AFTER = 2.0

    def __init__(
        self, now: Callable[[], float] = time.perf_counter, timer: Callable[..., Any] = threading.Timer
    ) -> None:
        self._now, self._new_timer = now, timer
        self._depth = 0  # a function that others call is compiled while they are
        self._seconds_spent = 0.0
        self._started_at: float | None = None
        self._has_printed = False
        self._timer: Any = None
        self._gc_was_enabled = False

    def on_start(self, event: Any) -> None:
        """A function begins to be compiled."""
        dispatcher = event.data["dispatcher"]
        if self._depth == 0 and not isinstance(dispatcher._cache, DiskCache):
            return  # somebody else's
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
        """A function is compiled, or cannot be."""
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
    """Let a `CompilationNotice` watch from now on."""
    event.register("numba:compile", CompilationNotice())


class DiskCache(_Cache):
    """What Numba asks for compiled code of a function, and gives it to: one file per signature and processor.

    A file begins with the stamp of the sources and the digest of the rest. Another stamp is another version of the
    sources, whose code is made anew in silence; another digest is damage.

    Args:
        function: whose code.
        sources_digest: of the sources, 64 hexadecimal digits.
        has_unique_name: whether its qualified name tells it from others that are defined at the same place. Otherwise what it
            has from around does, which may differ between two processes; then it is compiled in both.
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
        """The folder; None where nothing can be written."""
        return None if cache_folder() is None else str(cache_folder())

    def enable(self) -> None:
        """Use files."""
        self._enabled = True

    def disable(self) -> None:
        """Use no files."""
        self._enabled = False

    def flush(self) -> None:
        """Remove the files of all functions of this name."""
        place = cache_folder()
        for path in place.glob(f"{self._name[:100]}-*.compiled") if place is not None else ():
            path.unlink(missing_ok=True)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled function; None where there is none, or a damaged one."""
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
            # All of Numba, which takes long to import, is needed only where the code calls what that brings.
            rtsys.initialize(target_context)
            if any(binding.address_of_symbol(name) is None for name in called):
                target_context.refresh()
            return CompileResult._rebuild(target_context, *reduced)
        except Exception:  # whatever a pickle raises
            _warn_damaged(str(path.parent))
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled function, if it can be kept."""
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
    """Once per process."""
    warnings.warn(
        f"compiled code in {place} is damaged, and is made anew; if this comes again, delete that folder",
        RuntimeWarning,
        stacklevel=2,
    )
