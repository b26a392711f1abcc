"""Mesh files from strangers: a shape that can be used, or one line; never a traceback, a hang or a crash."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sdfsim import SdfsimError
from sdfsim.shape.make import shape_from_mesh
from tests.hard_cases.worker import Worker
from tests.helpers.mesh_files import ORIGINALS, glb, taken_apart

SECONDS = 20.0  # of processor time; an ordinary file of this size takes 0.1
NUMBERS = [
    b"nan",
    b"inf",
    b"-1",
    b"0",
    b"1e308",
    b"-1e-308",
    b"99999999999",
    b"4294967296",
    b"abc",
    b"",
    b"1e",
    b"0x7f",
]
COUNTS = [0, -1, 1, 2, 3, 10**6, 2**31 - 1, 2**31, 2**32 - 1, 10**12, 2**63, 1.5, None, "12", True, [], {}]


class Strange(NamedTuple):
    """A mesh file: what it is called, and its bytes."""

    suffix: str
    content: bytes


class Outcome(NamedTuple):
    """What came of a file that was accepted."""

    vertices: int
    volume: float


def use(case: Strange, folder: str) -> Outcome:
    """What `simulate` does with a mesh, all but the fit. In the worker."""
    path = Path(folder) / f"strange.{case.suffix}"
    path.write_bytes(case.content)
    shape = shape_from_mesh(path, sdf="mesh")
    distance, gradient = shape.sdf(shape.nodes[:8])
    for array in (shape.mesh.vertices, shape.nodes, shape.com, shape.inertia, distance, gradient):
        assert np.isfinite(array).all()
    assert shape.volume > 0 and len(shape.nodes)
    assert shape.mesh.faces.min() >= 0 and shape.mesh.faces.max() < len(shape.mesh.vertices)
    return Outcome(len(shape.mesh.vertices), shape.volume)


def use_pair(pair: tuple[Strange, str]) -> Outcome:
    return use(*pair)


@pytest.fixture(scope="module")
def worker():
    made = Worker(use_pair, SECONDS)
    yield made
    made.close()


def _leaves(tree, path=()):
    """Paths to every value of a JSON tree."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in items:
        yield (*path, key)
        yield from _leaves(value, (*path, key))


@st.composite
def _glb_lies(draw: st.DrawFn) -> Strange:
    header, body = taken_apart(ORIGINALS["glb"])
    for _ in range(draw(st.integers(1, 3))):
        path = draw(st.sampled_from(list(_leaves(header))))
        place = header
        for key in path[:-1]:
            place = place[key]
        if draw(st.booleans()):
            place[path[-1]] = draw(st.sampled_from(COUNTS))
        else:
            del place[path[-1]]
    return Strange("glb", glb(header, body[: draw(st.sampled_from([len(body), len(body) // 2]))]))


@st.composite
def _spoiled_bytes(draw: st.DrawFn) -> Strange:
    name = draw(st.sampled_from(list(ORIGINALS)))
    data = bytearray(ORIGINALS[name])
    for _ in range(draw(st.integers(1, 2))):
        how = draw(st.sampled_from(["number", "number", "number", "flip", "cut", "drop", "double", "header"]))
        reach = min(len(data), 400) if how == "header" else len(data)
        start = draw(st.integers(0, max(reach - 1, 0)))
        stop = min(len(data), start + draw(st.integers(1, 30)))
        if how == "cut":
            del data[start:]
        elif how == "drop":
            del data[start:stop]
        elif how == "double":
            data[start:start] = data[start:stop]
        elif how == "number" and (found := list(re.finditer(rb"-?\d+(\.\d+)?(e[-+]?\d+)?", bytes(data[:20_000])))):
            match = draw(st.sampled_from(found))
            data[match.start() : match.end()] = draw(st.sampled_from(NUMBERS))
        elif start < len(data):
            data[start:stop] = draw(st.binary(min_size=stop - start, max_size=stop - start))
    return Strange(name.split("_")[0], bytes(data))


_suffixes = st.sampled_from(["obj", "ply", "stl", "glb", "gltf", "off"])
_wrong_suffix = st.builds(Strange, _suffixes, st.sampled_from(list(ORIGINALS.values())))
_noise = st.builds(Strange, _suffixes, st.binary(max_size=300))
strange_files = st.one_of(_spoiled_bytes(), _spoiled_bytes(), _spoiled_bytes(), _glb_lies(), _wrong_suffix, _noise)
common = {"deadline": None, "derandomize": True, "database": None, "suppress_health_check": list(HealthCheck)}


def try_one(worker: Worker, folder: Path, case: Strange) -> Outcome | SdfsimError:
    answer = worker((case, str(folder)))
    if isinstance(answer, SdfsimError):
        assert answer.message.isprintable() and len(answer.message) < 500, answer.message
        assert "allocate" not in answer.message and "MemoryError" not in answer.message, answer.message
    return answer


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("meshes")


@settings(max_examples=100, **common)
@given(case=strange_files)
def test_no_mesh_file_crashes_or_hangs(worker, folder, case):
    try_one(worker, folder, case)


@pytest.mark.slow
@settings(max_examples=600, **common)
@given(case=strange_files)
def test_hundreds_of_mesh_files(worker, folder, case):
    try_one(worker, folder, case)


@pytest.mark.parametrize("name", ORIGINALS)
def test_every_format_is_read(worker, folder, name):
    outcome = try_one(worker, folder, Strange(name.split("_")[0], ORIGINALS[name]))
    assert isinstance(outcome, Outcome)
    assert outcome.volume == pytest.approx(16 * np.sin(np.pi / 8) / 2 * (0.5**2 - 0.2**2) * 0.4, rel=1e-4)


@pytest.mark.parametrize("name", [name for name in ORIGINALS if name != "obj"])  # an OBJ does not say how long it is
def test_a_file_that_is_cut_short_is_refused(worker, folder, name):
    whole = ORIGINALS[name].rstrip()
    for part in (0.1, 0.3, 0.6, 0.9, 0.99):  # the last digit of a text may be missing without a trace
        cut = whole[: int(part * len(whole))]
        answer = try_one(worker, folder, Strange(name.split("_")[0], cut))
        assert isinstance(answer, SdfsimError), f"accepted at {part:.0%}: {answer}"
