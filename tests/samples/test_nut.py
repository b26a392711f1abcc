"""samples/nut.py: a nut turns down its bolt."""

import runpy
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "samples" / "nut.py"


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.0, 0.2])
def test_a_nut_goes_down_by_its_pitch_a_turn_or_locks(friction, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["nut.py", str(tmp_path), "--friction", str(friction), "--seconds", "0.8"])
    runpy.run_path(str(SCRIPT), run_name="__main__")
    turns, way = (float(word) for word in capsys.readouterr().out.split()[0:3:2])
    if friction:
        assert turns == pytest.approx(0.0, abs=0.01)
        assert way < 0.2
    else:
        assert 1.2 < turns < 1.7
        assert way == pytest.approx(2.0 * turns, abs=0.15)
    assert (tmp_path / "nut.mp4").is_file()
