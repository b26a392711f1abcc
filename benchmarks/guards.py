"""Takes one guard of stability after the other out of a copy of the project and tells which tests then fail.

    python benchmarks/guards.py [WORD...]

All guards, or those whose name holds one of the words. A guard without which every test passes is one that no test
needs: the exit code is 1 then. Each is a piece of source text and what replaces it.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
NEVER = "1e300"


@dataclass(frozen=True)
class Guard:
    """One guard.

    Attributes:
        name: what it is for.
        file: that holds it, below the root.
        text: of it, as often as it is there.
        instead: what takes its place.
        tests: files and options that pytest is given.
    """

    name: str
    file: str
    text: str
    instead: str
    tests: str


STATE = "tests/hard_cases/test_guards_state.py"
ENERGY, DEEP = "tests/hard_cases/test_guards_energy.py", "tests/hard_cases/test_gates_overlap.py tests/dynamics"
FILES, CRASH = "tests/hard_cases/test_fault_files.py", "tests/hard_cases/test_crash_commands.py -k killed_command"
CLAIMS = "tests/hard_cases/test_claims.py"
SECURE, SHAPES = "tests/hard_cases/test_security.py", "tests/hard_cases/test_gates_shapes.py tests/shape"
# fmt: off
GUARDS = (
    Guard("state is checked after a step", "sdfsim/dynamics/simulator.py",
          "if broken := self._fault(after, awake(self.bodies, after), self.state):", "if broken := None:", STATE),
    Guard("state that is set is checked", "sdfsim/dynamics/simulator.py",
          "if broken := self._fault(self.state, everybody(self.bodies)):", "if broken := None:", STATE),
    Guard("orientation is a rotation", "sdfsim/dynamics/check.py", "UNIT = 2e-6", f"UNIT = {NEVER}", STATE),
    Guard("place is not too far", "sdfsim/dynamics/check.py", "FARTHEST = 1e9", f"FARTHEST = {NEVER}", STATE),
    Guard("speed and way are not absurd", "sdfsim/dynamics/check.py", "FASTEST = 1e6", f"FASTEST = {NEVER}", STATE),
    Guard("spin can be followed", "sdfsim/dynamics/check.py", "MOST_TURN / dt", "10 * MOST_TURN / dt", STATE),
    Guard("nodes tell the turn", "sdfsim/dynamics/check.py", "LINE = 1e-5", "LINE = -1.0",
          "tests/hard_cases/test_gates_shapes.py tests/hard_cases/test_gates_input.py tests/dynamics"),
    Guard("shape matching: open turns stay", "sdfsim/dynamics/matching.py", "STAY = 1e-12", "STAY = 0.0",
          "tests/dynamics/test_matching.py"),
    Guard("shape matching: NaN of one body stays with it", "sdfsim/dynamics/matching.py",
          "a = torch.where(known[:, None, None], a, 0.0)", "pass", "tests/dynamics/test_matching.py"),
    Guard("shape matching: double precision", "sdfsim/dynamics/matching.py",
          "spread.double(), start.double()", "spread.float(), start.float()", "tests/dynamics/test_matching.py"),
    Guard("swallowed bodies part along one way", "sdfsim/dynamics/overlap.py",
          "if not len(contacts):", "if True:", DEEP),
    Guard("what runs away is held back", "sdfsim/dynamics/energy.py", "ESCAPE, LEAVE = 0.6, 6.0",
          f"ESCAPE, LEAVE = {NEVER}, {NEVER}", ENERGY),
    Guard("a step that leaps is held back", "sdfsim/dynamics/energy.py", "ESCAPE, LEAVE = 0.6, 6.0",
          f"ESCAPE, LEAVE = 0.6, {NEVER}", ENERGY),
    Guard("--guard energy allows no gain", "sdfsim/dynamics/energy.py",
          '0.0 if guard == "energy" else ESCAPE', "ESCAPE", ENERGY),
    Guard("normals where a gradient vanishes", "sdfsim/dynamics/contacts.py", "length > 1e-6", "length > -1.0",
          "tests/dynamics tests/hard_cases/test_gates_shapes.py"),
    Guard("length of gradients is bounded", "sdfsim/shape/far_field.py", "norm.clamp(*SLOPE)", "norm", SHAPES),
    Guard("gradients that vanish point outward", "sdfsim/shape/far_field.py",
          "torch.where(norm > 1e-6", "torch.where(norm > -1", SHAPES),
    Guard("outside of the box the distance is carried on", "sdfsim/shape/far_field.py", "if len(outside):",
          "if False:", SHAPES),
    Guard("no distance is below that to the solid's box", "sdfsim/shape/far_field.py", "short = (least > 0)",
          "short = (least < 0)", SHAPES),
    Guard("rotation does not drift in flight", "sdfsim/dynamics/freeflight.py",
          "orientation = normalise(", "orientation = (", "tests/dynamics"),
    Guard("files appear whole", "sdfsim/files.py", 'partial = path.with_name(f".{path.name}.{os.getpid()}.part")',
          "partial = path", CRASH),
    Guard("one run writes one folder", "sdfsim/files.py", "fcntl.LOCK_EX | fcntl.LOCK_NB", "fcntl.LOCK_SH", FILES),
    Guard("half-written files go", "sdfsim/files.py", 'folder.glob(".*.part")', 'folder.glob("none")', FILES),
    Guard("no pickle", "sdfsim/files.py", "allow_pickle=False", "allow_pickle=True", SECURE),
    Guard("archives do not swell", "sdfsim/files.py", "if unpacked > max(", "if 0 > max(", CLAIMS),
    Guard("scene files do not swell", "sdfsim/scene/source.py", "if grown > max(", "if 0 > max(", SECURE),
    Guard("paths stay in the scene's folder", "sdfsim/scene/schema.py", "if not self.allow_outside and not all(",
          "if False and not all(", SECURE),
    Guard("photos of absurd size", "pipeline/photo_file.py", "if width * height > MAX_PIXELS:", "if False:",
          SECURE + " tests/pipeline/test_photos.py"),
    Guard("viewer listens to this machine only", "sdfsim/viewer.py", 'LOOPBACK = "127.0.0.1"', 'LOOPBACK = "0.0.0.0"',
          SECURE),
)
# fmt: on


def copy_project(place: Path) -> None:
    """What git knows or would know, without its history."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    for name in listed.stdout.splitlines():
        if (ROOT / name).exists():
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, place / name)


def failing(place: Path, tests: str) -> list[str]:
    """The tests that fail in a copy, at most three; a program that dies is told as such."""
    environment = {**os.environ, "PYTHONPATH": str(place), "OMP_NUM_THREADS": "1"}
    options = ["--maxfail=3", "-m", "not slow and not gpu", "--tb=no", "-rf"]
    command = [sys.executable, "-m", "pytest", *options, *tests.split()]
    ended = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True)
    red = [line.split()[1] for line in ended.stdout.splitlines() if line.startswith("FAILED tests/")]
    if ended.returncode < 0:
        red.append(f"the tests' own process, by signal {-ended.returncode}")
    elif ended.returncode and not red:
        raise SystemExit(f"{' '.join(command)}:\n{ended.stdout}{ended.stderr}")
    return red


def main() -> int:
    """Prints a line a guard."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*")
    words = parser.parse_args().words
    chosen = [guard for guard in GUARDS if not words or any(word in guard.name for word in words)]
    unneeded = 0
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        copy_project(place)
        for tests in {guard.tests for guard in chosen}:
            if red := failing(place, tests):
                raise SystemExit(f"these fail with all guards in place: {', '.join(red)}")
        for guard in chosen:
            path = place / guard.file
            source = path.read_text()
            if guard.text not in source:
                raise SystemExit(f"{guard.file}: no {guard.text!r} any more; this list is out of date")
            path.write_text(source.replace(guard.text, guard.instead))
            red = failing(place, guard.tests)
            path.write_text(source)
            unneeded += not red
            print(f"{guard.name}: {'red: ' + ', '.join(red) if red else 'NO TEST NEEDS IT'}", flush=True)
    return int(unneeded > 0)


if __name__ == "__main__":
    sys.exit(main())
