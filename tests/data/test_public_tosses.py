"""Public recordings by name: fetched from a server in the test, checked, and made into a file that identify reads."""

import hashlib
import io
import tarfile
import threading
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sdfsim.apps.observed import load_recordings
from sdfsim.base.errors import SdfsimError
from sdfsim.data import public_tosses as room
from sdfsim.data.public_tosses import NORMAL, SETS, TILTED, Links, links_of, lowest, public_tosses, upright

TURN = Rotation.from_euler("xyz", [20, -35, 50], degrees=True)


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *arguments):
        """Nothing on stderr."""


def cube_rows(count: int) -> np.ndarray:
    """[1, T, 19] a cube that falls, in half sides of 52.4 mm."""
    time = np.arange(count)[:, None] / 148.0
    place = np.array([0.1, 0.2, 0.5]) + time * [1.0, 0.0, 0.0] - 0.5 * 9.81 * time**2 * [0.0, 0.0, 1.0]
    quat = np.roll(TURN.as_quat(), 1)  # wxyz
    return np.concatenate([place / 0.0524, np.tile(quat, (count, 1)), np.zeros((count, 12))], 1)[None]


def elbow_rows(count: int) -> np.ndarray:
    """[T, 15] a bent elbow that falls."""
    time = np.arange(count)[:, None] / 148.0
    place = np.array([0.1, 0.2, 0.5]) - 0.5 * 9.64 * time**2 * [0.0, 0.0, 1.0]
    quat = np.tile(np.roll(TURN.as_quat(), 1), (count, 1))
    return np.concatenate([quat, place, np.full((count, 1), 0.7), np.zeros((count, 7))], 1)


ROWS = {"contactnets-cube": cube_rows, "contactnets-elbow": elbow_rows}


def packed(name: str) -> tuple[bytes, str]:
    """An archive like that of a commit, with two tosses and files that are none, and the sum of the tosses."""
    rows, hashed, folder = ROWS[name], hashlib.sha256(), SETS[name].folder
    content: dict[str, bytes] = {"x-1/README.md": b"", "x-1/assets/other/0.pt": b"nothing"}
    for k, count in enumerate((12, 15)):
        torch.save(torch.from_numpy(rows(count)), file := io.BytesIO())
        content[f"x-1/assets/{folder}/{k}.pt"] = file.getvalue()
        hashed.update(file.getvalue())
    with tarfile.open(fileobj=(made := io.BytesIO()), mode="w:gz") as archive:
        for path, data in content.items():
            member = tarfile.TarInfo(path)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    return made.getvalue(), hashed.hexdigest()


@pytest.fixture(params=list(SETS))
def site(request, tmp_path, monkeypatch):
    """The name of a set, and where its archive lies on a server."""
    name, root = request.param, tmp_path / "site"
    content, checksum = packed(name)
    known = replace(SETS[name], count=2, checksum=checksum)
    file = root / known.repository / "tar.gz" / known.commit
    file.parent.mkdir(parents=True)
    file.write_bytes(content)
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(root)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    monkeypatch.setattr(room, "GITHUB", f"http://127.0.0.1:{server.server_port}")
    monkeypatch.setattr(room, "SETS", {name: known})
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.chdir(tmp_path)
    yield name, file, content
    server.shutdown()
    server.server_close()


def test_a_set_is_fetched_once_and_read_as_recordings(site, tmp_path):
    name, file, _ = site
    said: list[str] = []
    folder = public_tosses(Path(name), lambda _, message: said.append(message))
    assert folder == tmp_path / "cache" / "sdfsim" / "public" / name and len(said) == 1
    file.unlink()
    assert public_tosses(Path(name)) == folder
    found, scene = load_recordings([folder], folder / "scene.yaml")
    assert [len(r.known) for r in found] == [12, 15] and found[0].dt == pytest.approx(1.0 / 148.0)
    assert scene.bodies[-1].motion == "dynamic"
    first = found[0].goal[0][:, 0], Rotation.from_quat(found[0].goal[1][:, 0])
    if name == "contactnets-cube":
        assert first[0][0] == pytest.approx([0.1, 0.2, 0.5]) and (first[1] * TURN.inv()).magnitude().max() < 1e-9
    else:  # the hinge is at the same point of both, and bent by 0.7
        other = found[0].goal[0][:, 1], Rotation.from_quat(found[0].goal[1][:, 1])
        ends = first[0] + first[1].apply([-0.035, 0.06, 0.0]), other[0] - other[1].apply([0.035, 0.0, 0.0])
        assert ends[0] == pytest.approx(ends[1], abs=1e-12)
        assert (first[1].inv() * other[1]).as_rotvec() == pytest.approx(np.tile([0.0, 0.7, 0.0], (12, 1)))


def test_other_tosses_are_refused_and_nothing_kept(site, tmp_path):
    name, file, content = site
    file.write_bytes(packed("contactnets-cube" if name.endswith("elbow") else "contactnets-elbow")[0])
    with pytest.raises(SdfsimError, match="not the expected tosses: its 2 files have the SHA-256"):
        public_tosses(Path(name))
    assert not list((tmp_path / "cache").rglob("*.npz"))
    file.write_bytes(content)
    assert (public_tosses(Path(name)) / "tosses.npz").is_file()


def test_without_a_network_it_says_what_to_put_where(site, tmp_path):
    name, file, content = site
    file.unlink()
    with pytest.raises(SdfsimError, match="cannot be fetched") as caught:
        public_tosses(Path(name))
    folder = tmp_path / "cache" / "sdfsim" / "public" / name
    assert caught.value.hint == f"put it into {folder} by hand, as {file.name}.tar.gz"
    folder.mkdir(parents=True)
    (folder / f"{file.name}.tar.gz").write_bytes(content)
    assert (public_tosses(Path(name)) / "scene.yaml").is_file()


def test_a_folder_of_the_name_is_that_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("contactnets-cube").mkdir()
    assert public_tosses(Path("contactnets-cube")) == Path("contactnets-cube")
    assert public_tosses(Path("mine.csv")) == Path("mine.csv")


def test_elbows_of_the_first_session_are_turned_onto_the_table():
    level = links_of(np.array([[0.0, 0.0, 0.025]]), Rotation.identity(1), np.array([0.4]))
    lean = Rotation.align_vectors([NORMAL], [[0.0, 0.0, 1.0]])[0]
    place = lean.apply(level.position[0])[None] + [0.3, 0.2, 0.01]
    turn = (lean * Rotation.from_quat(level.quat_xyzw[0])).as_quat()[None]
    seen = Links(place, turn)
    found = upright(seen, TILTED - 1)
    up = Rotation.from_quat(found.quat_xyzw[0]).as_matrix()[:, 2, 2]
    assert up[0] == pytest.approx(1.0, abs=1e-6) and lowest(found).min() == pytest.approx(0.0, abs=1e-12)
    assert upright(seen, TILTED) is seen
