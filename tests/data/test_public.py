"""Public shapes and recordings by name: fetched from a server in the test, checked, kept; and what is refused."""

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
from sdfsim.data import public_shapes
from sdfsim.data import public_tosses as room
from sdfsim.data.public_shapes import SUMS, public_folder
from sdfsim.data.public_tosses import NORMAL, SETS, TILTED, Links, links_of, lowest, public_tosses, upright

TURN = Rotation.from_euler("xyz", [20, -35, 50], degrees=True)


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *arguments):
        """Nothing on stderr."""


def served(folder: Path) -> tuple[ThreadingHTTPServer, str]:
    """A server of a folder, and its address."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server, f"http://127.0.0.1:{server.server_port}"


def archived(members: dict[str, bytes]) -> bytes:
    """A .tar.gz of these files."""
    with tarfile.open(fileobj=(made := io.BytesIO()), mode="w:gz") as archive:
        for name, content in members.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))
    return made.getvalue()


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
    return archived(content), hashed.hexdigest()


@pytest.fixture(params=list(SETS))
def site(request, tmp_path, monkeypatch):
    """The name of a set, and where its archive lies on a server."""
    name, root = request.param, tmp_path / "site"
    content, checksum = packed(name)
    known = replace(SETS[name], count=2, checksum=checksum)
    file = root / known.repository / "tar.gz" / known.commit
    file.parent.mkdir(parents=True)
    file.write_bytes(content)
    server, address = served(root)
    monkeypatch.setattr(room, "GITHUB", address)
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


VISUAL, COLLISION, SCAN = "cone/visual_geometry.obj", "cone/collision_geometry.obj", "ycb_soup_can.obj"
CONTENT = {VISUAL: b"v 0 0 1\n", COLLISION: b"v 0 0 2\n", SCAN: b"v 0 0 3\n"}


class Site:
    """A server of a folder, and a cache to fetch into."""

    def __init__(self, root: Path) -> None:
        self.root = root / "shop"
        self.root.mkdir()
        self.cache = root / "cache"
        self.server, self.url = served(self.root)

    def close(self) -> None:
        self.server.shutdown()
        self.server.server_close()

    def pack(self, members: dict[str, bytes]) -> None:
        (self.root / "cone.tar.gz").write_bytes(archived(members))

    def kept(self) -> list[Path]:
        return [file for file in self.cache.rglob("*") if file.is_file()]


@pytest.fixture
def shop(tmp_path, monkeypatch):
    shop = Site(tmp_path)
    sums = {file: hashlib.sha256(content).hexdigest() for file, content in CONTENT.items()}
    monkeypatch.setattr(public_shapes, "KUBRIC", shop.url)
    monkeypatch.setattr(public_shapes, "YCB", shop.url)
    monkeypatch.setattr(public_shapes, "SUMS", {"kubasic": {f: sums[f] for f in (VISUAL, COLLISION)},
                                                "ycb": {SCAN: sums[SCAN]}})  # fmt: skip
    monkeypatch.setenv("XDG_CACHE_HOME", str(shop.cache))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.chdir(tmp_path)
    scan = shop.root / "YcbSoupCan" / "textured_simple_reoriented.obj"
    scan.parent.mkdir()
    scan.write_bytes(CONTENT[SCAN])
    shop.pack({"cone/data.json": b"{}", **{file: CONTENT[file] for file in (VISUAL, COLLISION)}})
    yield shop
    shop.close()


@pytest.mark.parametrize("name", ["kubasic", "ycb"])
def test_a_set_is_fetched_once(shop, name):
    said = []
    folder = public_folder(Path(name), lambda fraction, message: said.append(message))
    assert folder == shop.cache / "sdfsim" / "public" / name
    assert {str(file.relative_to(folder)): file.read_bytes() for file in shop.kept()} == {
        file: CONTENT[file] for file in public_shapes.SUMS[name]
    }
    assert len(said) == 1 and shop.url in said[0]
    shop.close()
    assert public_folder(Path(name)) == folder


def test_a_file_with_another_sum_is_refused_and_nothing_kept(shop):
    shop.pack({VISUAL: CONTENT[VISUAL], COLLISION: b"v 6 6 6\n"})
    with pytest.raises(SdfsimError, match=r"cone\.tar\.gz: collision_geometry\.obj: ") as caught:
        public_folder(Path("kubasic"))
    for content in (b"v 6 6 6\n", CONTENT[COLLISION]):
        assert hashlib.sha256(content).hexdigest() in caught.value.message
    assert not shop.kept()


def test_a_path_in_an_archive_leads_nowhere(shop, tmp_path):
    before = set(tmp_path.rglob("*"))
    shop.pack({"../../../outside.obj": b"", str(tmp_path / "outside.obj"): b"", "../../" + VISUAL: CONTENT[VISUAL],
               "../" + COLLISION: CONTENT[COLLISION]})  # fmt: skip
    folder = public_folder(Path("kubasic"))
    assert sorted(shop.kept()) == [folder / COLLISION, folder / VISUAL]
    assert {path for path in tmp_path.rglob("*") if not path.is_relative_to(shop.cache)} == before


def test_without_a_network_it_says_which_shapes_to_put_where(shop):
    shop.close()
    folder = shop.cache / "sdfsim" / "public" / "kubasic"
    with pytest.raises(SdfsimError, match=f"(?m)^{shop.url}/cone.tar.gz: .*refused$") as caught:
        public_folder(Path("kubasic"))
    assert caught.value.hint == f"put these files into {folder} by hand: {VISUAL}, {COLLISION}"
    for file in (VISUAL, COLLISION):
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_bytes(CONTENT[file])
    assert public_folder(Path("kubasic")) == folder


@pytest.mark.parametrize(("name", "folder", "count"), [("kubasic", "kubasic", 22), ("ycb", "meshes", 6)])
def test_the_sums_are_those_of_the_files_at_hand(data_dir, name, folder, count):
    assert len(SUMS[name]) == count
    for file, expected in SUMS[name].items():
        assert hashlib.sha256((data_dir / folder / file).read_bytes()).hexdigest() == expected, file
