"""What is compiled is told before it is waited for: once, where it is not kept, and nothing else is said."""

import importlib.util
import time
from pathlib import Path

import numpy as np
import pytest
from numba import typeof
from numba.core import config

from sdfsim.base import compiling
from sdfsim.base.compiling import compile_before, is_compiled

SOURCE = "from numba import njit\n\n\n@njit(cache=True)\ndef double(x):\n    return 2 * x\n"


def loaded(file: Path):
    spec = importlib.util.spec_from_file_location("doubling", file)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.double


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """A folder of modules whose compiled code is kept below it, of which nothing is ready yet."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "kept"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kept"))
    monkeypatch.setattr(compiling, "_ready", set())
    return tmp_path


@pytest.mark.parametrize("cache", ["True", "False"])
def test_what_is_run_is_what_another_process_has_kept(kept, caplog, cache):
    (kept / f"doubling_{cache}.py").write_text(SOURCE.replace("True", cache))
    double = importlib.import_module(f"doubling_{cache}").double
    compile_before([(double, (typeof(3),))], "doubling")
    assert caplog.messages == ["compiling doubling, once for this version: about 20 s"]
    assert is_compiled(double) == (cache == "True") and double(3) == 6
    assert (sum(double.stats.cache_hits.values()), len(double.stats.cache_misses)) == (1, 0) or cache == "False"


def test_a_form_for_other_types_is_told_though_one_is_compiled(kept, caplog):
    """Arrays of another layout need code of their own, which used to be compiled without a word."""
    (kept / "layouts.py").write_text(SOURCE)
    double, before = importlib.import_module("layouts").double, compiling.seconds_spent()
    for array, told in ((np.ones((2, 2)), 1), (np.zeros((3, 3)), 1), (np.ones((4, 4))[::2], 2), (np.ones((2, 2)), 2)):
        compile_before([(double, (typeof(array),))], "doubling")
        assert len(caplog.messages) == told
        assert double(array).tolist() == (2 * array).tolist()
    assert not double.stats.cache_misses  # nothing was compiled here
    assert compiling.seconds_spent() > before


def test_whatever_else_is_compiled_is_told_once_and_is_no_part_of_the_time(tmp_path, monkeypatch, caplog):
    file = tmp_path / "alone.py"
    file.write_text(SOURCE.replace("cache=True", "cache=False"))
    monkeypatch.setattr(compiling, "_said", False)
    compiling.say_compiling()
    function, other = loaded(file), loaded(file)
    began, clock, before = time.perf_counter(), compiling.running(), compiling.seconds_spent()
    assert function(3) == 6 and other(3.0) == 6.0
    took, spent = time.perf_counter() - began, compiling.seconds_spent() - before
    assert caplog.messages == ["compiling code for this machine, once for this version: some seconds"]
    assert 0.5 * took < spent < took
    assert compiling.running() - clock == pytest.approx(took - spent, abs=0.01)
