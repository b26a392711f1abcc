"""Packages of extras: missing, or broken."""

import sys

import pytest

from sdfsim.base.lazy import NotInstalled, optional


def test_a_missing_package_is_told_how_to_get(tmp_path):
    with pytest.raises(NotInstalled, match="Gizmo is not installed") as error:
        optional("gizmo_that_is_nowhere.part", "Gizmo", "bench")
    assert error.value.hint == "pip install 'sdfsim[bench]'"


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        ("raise ImportError('libGL.so.1: cannot open shared object file')", "ImportError: libGL.so.1: cannot open"),
        ("import gears_that_are_nowhere", "ModuleNotFoundError: No module named 'gears_that_are_nowhere'"),
        ("raise OSError('undefined symbol: mj_step')", "OSError: undefined symbol: mj_step"),
        ("raise AttributeError('_ARRAY_API not found')", "AttributeError: _ARRAY_API not found"),
    ],
)
def test_a_broken_package_is_told_with_its_own_error(tmp_path, monkeypatch, fault, told):
    (tmp_path / "gizmo.py").write_text(fault)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "gizmo", raising=False)
    with pytest.raises(NotInstalled) as error:
        optional("gizmo", "Gizmo", "bench")
    assert "Gizmo is installed, but does not load" in error.value.message and told in error.value.message
    assert "not installed" not in error.value.message
