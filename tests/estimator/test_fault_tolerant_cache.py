"""The caches of compiled and generated code: reuse, damage, and unwritable folders."""

import gc
import importlib
import itertools
import os
import subprocess
import sys
import warnings
from pathlib import Path
from typing import ClassVar

import pytest
from numba.core import event

from estimator.compilation import fault_tolerant_cache
from estimator.engine import source_cache as generated

SOURCE = """
from estimator.compilation.simd import kernel

@kernel
def run(x):
    return 2 * x

def adder(shift):
    @kernel
    def add(x):
        return x + shift
    return add
"""


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder of its own for compiled code, and a module `run_of_compiled`."""
    (tmp_path / "run_of_compiled.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "compiled"))
    fault_tolerant_cache.cache_folder.cache_clear()
    fault_tolerant_cache._warn_damaged.cache_clear()
    yield tmp_path / "compiled"
    sys.modules.pop("run_of_compiled", None)
    fault_tolerant_cache.cache_folder.cache_clear()
    fault_tolerant_cache._warn_damaged.cache_clear()


def fresh():
    """The module as another process would see it."""
    sys.modules.pop("run_of_compiled", None)
    importlib.invalidate_caches()
    return importlib.import_module("run_of_compiled")


def called():
    """The result of a new kernel, and whether its code came from disk."""
    run = fresh().run
    return run(21), sum(run.stats.cache_hits.values())


def test_compiled_code_is_read_again(place):
    assert called() == (42, 0)
    assert called() == (42, 1)
    assert len(list(place.iterdir())) == 1
    fresh().run._cache.flush()
    assert not list(place.iterdir())
    assert called() == (42, 0)


def test_code_that_calls_what_numba_brings_is_read_by_another_process(tmp_path):
    """The symbols of BLAS are loaded only after Numba has imported them."""
    source = "from estimator.compilation.simd import kernel\n@kernel\ndef run(x):\n    return x @ x\n"
    (tmp_path / "run_of_compiled.py").write_text(source)
    program = "import numpy as np\nfrom run_of_compiled import run\n"
    program += "print(run(np.ones(3)), sum(run.stats.cache_hits.values()))"
    variables = {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path]), "NUMBA_CACHE_DIR": str(tmp_path / "code")}
    command = [sys.executable, "-c", program]
    for expected in ("3.0 0", "3.0 1"):
        finished = subprocess.run(command, env=os.environ | variables, capture_output=True, text=True)
        assert finished.stdout.strip() == expected, finished.stderr


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: content[:50],
        lambda content: content[:100],
        lambda content: content[: len(content) // 2],
        lambda content: content[:-1],
        lambda content: content[:1000] + bytes([content[1000] ^ 1]) + content[1001:],
        lambda content: content[:128] + b"no pickle",
    ],
)
def test_damaged_code_is_made_anew_with_one_warning(place, damage):
    called()
    (path,) = place.iterdir()
    whole = path.read_bytes()
    path.write_bytes(damage(whole))
    with pytest.warns(RuntimeWarning, match=f"compiled code in {place} is damaged, and is compiled anew") as caught:
        results = [called(), called(), (path.write_bytes(damage(whole)), called())[1]]
    assert results == [(42, 0), (42, 1), (42, 0)]
    assert len(caught) == 1


def test_code_of_other_sources_is_replaced_in_silence(place):
    called()
    (path,) = place.iterdir()
    content = path.read_bytes()
    path.write_bytes(b"0" * 64 + content[64:])
    assert called() == (42, 0)
    assert path.read_bytes()[:64] == content[:64]


def test_code_of_another_processor_is_left_to_it(place, monkeypatch):
    """A folder that two machines share: each finds its own."""
    own = type(fresh().run.targetctx.codegen()).magic_tuple
    called()
    with monkeypatch.context() as other:
        another = "numba.core.codegen.CPUCodegen.magic_tuple"
        other.setattr(another, lambda self: (own(self)[0], "another", "+avx512,+amx"))
        assert [called(), called()] == [(42, 0), (42, 1)]
    assert called() == (42, 1)
    assert len(list(place.iterdir())) == 2


def test_functions_with_other_surroundings_have_other_code(place):
    module = fresh()
    assert [module.adder(shift)(1) for shift in (1, 10, 1)] == [2, 11, 2]


def nowhere(monkeypatch, tmp_path):
    """No folder can be made: all candidates are below a file."""
    (tmp_path / "file").write_text("")
    for name in ("NUMBA_CACHE_DIR", "HOME", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, str(tmp_path / "file" / "folder"))


def test_where_nothing_can_be_written_it_runs_with_one_warning(place, tmp_path, monkeypatch):
    nowhere(monkeypatch, tmp_path)
    with pytest.warns(RuntimeWarning, match="no folder can be written .* set NUMBA_CACHE_DIR") as caught:
        results = called(), called(), loaded()
    assert results == ((42, 0), (42, 0), (1, 1))
    assert len(caught) == 1
    fresh().run._cache.flush()
    assert fresh().run._cache.cache_path is None


def test_a_folder_that_becomes_read_only_costs_nothing_but_time(place, monkeypatch):
    assert fault_tolerant_cache.cache_folder() == place

    def refuse(*args, **kwargs):
        raise PermissionError("read-only file system")

    monkeypatch.setattr(fault_tolerant_cache.tempfile, "mkstemp", refuse)
    assert called() == (42, 0)
    assert loaded()[0] == 1
    assert not list(place.iterdir())


def test_a_user_without_a_home_gets_no_folder_called_tilde(tmp_path, monkeypatch):
    nowhere(monkeypatch, tmp_path)
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    monkeypatch.chdir(tmp_path)
    fault_tolerant_cache.cache_folder.cache_clear()
    with pytest.warns(RuntimeWarning, match="no folder can be written"):
        assert fault_tolerant_cache.cache_folder() is None
    fault_tolerant_cache.cache_folder.cache_clear()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file"]


def test_the_package_starts_without_a_home_and_with_nothing_to_write(tmp_path):
    (tmp_path / "file").write_text("")
    environment = {k: v for k, v in os.environ.items() if k not in ("HOME", "XDG_CACHE_HOME")}
    environment["NUMBA_CACHE_DIR"] = environment["XDG_CACHE_HOME"] = str(tmp_path / "file" / "folder")
    text = "import warnings; warnings.simplefilter('error'); import estimator.online, estimator.engine.kernels"
    subprocess.run([sys.executable, "-c", text], env=environment, check=True, cwd=Path(__file__).parents[2])


# --- Generated source ----------------------------------------------------------------------------------------------


def loaded():
    """The result of generated source, and how often it was generated."""
    made = []

    def make():
        made.append(1)
        return "def answer():\n    return number\n"

    code = generated.load_generated("toy", "answer", "key", make, {"number": 1})
    return code.answer(), len(made)


def test_generated_source_is_read_again(place):
    assert loaded() == (1, 1)
    assert loaded() == (1, 0)


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: content[: len(content) // 2],
        lambda content: content.replace(b"return", b"retirn"),
        lambda content: content.replace(b"number", b"numbes"),
        lambda content: content + b"boom()\n",
        lambda content: b"\xff" + content,
    ],
)
def test_damaged_source_is_generated_anew_in_silence(place, damage):
    loaded()
    (path,) = place.glob("toy-answer-*.py")
    whole = path.read_bytes()
    assert damage(whole) != whole
    path.write_bytes(damage(whole))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert loaded() == (1, 1)
    assert path.read_bytes() == whole
    assert loaded() == (1, 0)


class Timer:
    """A timer that fires at once if its delay is below a compilation time of 1.5 s."""

    asked: ClassVar[list[float]] = []

    def __init__(self, seconds, function, arguments):
        self.asked.append(seconds)
        self.start = (lambda: function(*arguments)) if seconds < 1.5 else lambda: None

    def cancel(self):
        pass


def test_a_long_compilation_is_announced_once(place, monkeypatch, capsys):
    monkeypatch.setattr(Timer, "asked", [])
    watching = fault_tolerant_cache.CompilationNotice(now=itertools.count(0.0, 1.5).__next__, timer=Timer)
    event.register("numba:compile", watching)
    try:
        assert called() == (42, 0)
        assert capsys.readouterr().err == ""
        assert [fresh().adder(shift)(1) for shift in (2, 3)] == [3, 4]
    finally:
        event.unregister("numba:compile", watching)
    assert Timer.asked == [2.0, 0.5]
    (line,) = capsys.readouterr().err.splitlines()
    assert line in {f"duffing-env is compiling {name}: seconds to minutes, once" for name in ("run", "add")}
    assert len(line) <= 80


def test_a_compilation_longer_than_a_late_timer_is_announced_with_the_next(place, monkeypatch):
    """A timer that is late, as on a busy machine."""
    monkeypatch.setattr(Timer, "asked", [])
    watching = fault_tolerant_cache.CompilationNotice(now=itertools.count(0.0, 60.0).__next__, timer=Timer)
    event.register("numba:compile", watching)
    try:
        assert called() == (42, 0)
        assert fresh().adder(2)(1) == 3
    finally:
        event.unregister("numba:compile", watching)
    assert Timer.asked == [2.0, 0.0]


def test_garbage_is_collected_again_after_compilation(place):
    called()
    assert gc.isenabled()
    gc.disable()
    try:
        fresh().adder(2)(1)
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_garbage_of_a_host_application_is_not_frozen():
    imports = "import gc, estimator.compilation.fault_tolerant_cache, agents.commands"
    text = f"{imports}; print(gc.get_freeze_count(), gc.isenabled())"
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0", "True"]
