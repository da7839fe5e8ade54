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

from estimator.numba_internals import CompileResult, _Cache, dumps, event, rtsys
from estimator.support.file_io import write_atomically


@cache
def folder() -> Path | None:
    """Where generated and compiled code is kept; None, with one RuntimeWarning, where nothing can be written.

    ``NUMBA_CACHE_DIR`` where it is set; else ``__pycache__`` beside this file; else the user's cache folder.
    """
    for place in _places():
        try:
            place.mkdir(parents=True, exist_ok=True)
            handle, probe = tempfile.mkstemp(dir=place)
            os.close(handle)
            os.unlink(probe)
        except OSError:
            continue
        return place
    warnings.warn(
        "no folder can be written for compiled code, so it is compiled anew in every process; set NUMBA_CACHE_DIR to a "
        "folder that can",
        RuntimeWarning,
        stacklevel=2,
    )
    return None


def _places() -> list[Path]:
    import platformdirs

    wished = os.environ.get("NUMBA_CACHE_DIR")
    places = [Path(wished).absolute()] if wished else [Path(__file__).parent / "__pycache__"]
    try:
        of_user = Path(platformdirs.user_cache_dir("duffing-env"))
    except RuntimeError:  # a user without a home
        return places
    return [*places, of_user] if of_user.is_absolute() else places


def write(path: Path, content: bytes) -> None:
    """Write a file in one piece; a full disk only costs the next process the time to make it again."""
    with suppress(OSError):
        write_atomically(path, content)


class Compilation(event.Listener):
    """Watches over compilation: Numba tells when it begins and ends to compile a function.

    What takes longer than `PATIENCE` says on stderr that it compiles, once in a process. Python's garbage collector
    rests meanwhile: it looks through all that Numba builds, again and again, and finds nothing.

    Args:
        now: the time [s].
        timer: makes what calls a function after so many seconds.
    """

    #: Seconds that the process may spend compiling before it says so.
    PATIENCE = 2.0

    def __init__(
        self, now: Callable[[], float] = time.perf_counter, timer: Callable[..., Any] = threading.Timer
    ) -> None:
        self._now, self._make_timer = now, timer
        self._depth = 0  # a function that others call is compiled while they are
        self._spent = 0.0
        self._began: float | None = None
        self._said = False
        self._timer: Any = None
        self._collects = False

    def on_start(self, event: Any) -> None:
        """A function begins to be compiled."""
        dispatcher = event.data["dispatcher"]
        if self._depth == 0 and not isinstance(dispatcher._cache, Compiled):
            return  # somebody else's
        self._depth += 1
        if self._depth > 1:
            return
        self._collects = gc.isenabled()
        gc.disable()
        self._began = self._now()
        if not self._said:
            rest = max(0.0, self.PATIENCE - self._spent)
            self._timer = self._make_timer(rest, self._say, [dispatcher.py_func])
            self._timer.daemon = True
            self._timer.start()

    def on_end(self, event: Any) -> None:
        """A function is compiled, or cannot be."""
        self._depth = max(0, self._depth - 1)
        if self._depth > 0 or self._began is None:
            return
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._spent += self._now() - self._began
        self._began = None
        if self._collects:
            gc.enable()

    def _say(self, function: Callable[..., Any]) -> None:
        self._said = True
        kept = "in every process" if folder() is None else "once"
        said = f"duffing-env is compiling {function.__name__:.17}: seconds to minutes, {kept}"
        print(said, file=sys.stderr, flush=True)


@cache
def watch_compilation() -> None:
    """Let a `Compilation` watch from now on."""
    event.register("numba:compile", Compilation())


class Compiled(_Cache):
    """What Numba asks for compiled code of a function, and gives it to: one file per signature and processor.

    A file begins with the stamp of the sources and the digest of the rest. Another stamp is another version of the
    sources, whose code is made anew in silence; another digest is damage.

    Args:
        function: whose code.
        stamp: of the sources, 64 hexadecimal digits.
        named: whether its qualified name tells it from others that are defined at the same place. Otherwise what it
            has from around does, which may differ between two processes; then it is compiled in both.
    """

    def __init__(self, function: Callable[..., Any], stamp: str, named: bool = False) -> None:
        code = function.__code__
        self._name = f"{Path(code.co_filename).stem}.{function.__qualname__}".replace("<", "").replace(">", "")
        self._where = f"{code.co_filename}:{code.co_firstlineno}:{sys.version_info[:2]}:{numba.__version__}"
        self._around = () if named else function.__closure__ or ()
        self._stamp = stamp.encode()
        self._enabled = True
        watch_compilation()

    @property
    def cache_path(self) -> str | None:
        """The folder; None where nothing can be written."""
        return None if folder() is None else str(folder())

    def enable(self) -> None:
        """Use files."""
        self._enabled = True

    def disable(self) -> None:
        """Use no files."""
        self._enabled = False

    def flush(self) -> None:
        """Remove the files of all functions of this name."""
        place = folder()
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
        if path is None or (stamp != self._stamp and len(content) > 128):
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
            _warn_of_damage(str(path.parent))
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled function, if it can be kept."""
        path = self._path(sig, data.codegen)
        if path is None or data.lifted or data.library.has_dynamic_globals:
            return
        functions = data.library._final_module.functions
        called = [f.name for f in functions if f.is_declaration and not f.name.startswith("llvm.")]
        payload = dumps((called, *data._reduce()))
        write(path, self._stamp + hashlib.sha256(payload).hexdigest().encode() + payload)

    def _path(self, sig: Any, codegen: Any) -> Path | None:
        place = folder() if self._enabled else None
        if place is None:
            return None
        key = hashlib.sha256(f"{self._where}\n{self._name}\n{sig}\n{codegen.magic_tuple()}".encode())
        key.update(dumps(tuple(cell.cell_contents for cell in self._around)))
        return place / f"{self._name[:100]}-{key.hexdigest()[:16]}.compiled"


@cache
def _warn_of_damage(place: str) -> None:
    """Once per process."""
    warnings.warn(
        f"compiled code in {place} is damaged, and is made anew; if this comes again, delete that folder",
        RuntimeWarning,
        stacklevel=2,
    )
