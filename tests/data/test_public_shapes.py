"""Public shapes by name: fetched from a server in the test, checked, kept; and what is refused."""

import hashlib
import io
import tarfile
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from sdfsim.base.errors import SdfsimError
from sdfsim.data import public_shapes
from sdfsim.data.public_shapes import SUMS, public_folder

VISUAL, COLLISION, SCAN = "cone/visual_geometry.obj", "cone/collision_geometry.obj", "ycb_soup_can.obj"
CONTENT = {VISUAL: b"v 0 0 1\n", COLLISION: b"v 0 0 2\n", SCAN: b"v 0 0 3\n"}


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *arguments):
        """Nothing on stderr."""


class Site:
    """A server of a folder, and a cache to fetch into."""

    def __init__(self, root: Path) -> None:
        self.root = root / "site"
        self.root.mkdir()
        self.cache = root / "cache"
        self.server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(self.root)))
        self.url = f"http://127.0.0.1:{self.server.server_port}"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def close(self) -> None:
        self.server.shutdown()
        self.server.server_close()

    def pack(self, members: dict[str, bytes]) -> None:
        with tarfile.open(self.root / "cone.tar.gz", "w:gz") as archive:
            for name, content in members.items():
                member = tarfile.TarInfo(name)
                member.size = len(content)
                archive.addfile(member, io.BytesIO(content))

    def kept(self) -> list[Path]:
        return [file for file in self.cache.rglob("*") if file.is_file()]


@pytest.fixture
def site(tmp_path, monkeypatch):
    site = Site(tmp_path)
    sums = {file: hashlib.sha256(content).hexdigest() for file, content in CONTENT.items()}
    monkeypatch.setattr(public_shapes, "KUBRIC", site.url)
    monkeypatch.setattr(public_shapes, "YCB", site.url)
    monkeypatch.setattr(public_shapes, "SUMS", {"kubasic": {f: sums[f] for f in (VISUAL, COLLISION)},
                                                "ycb": {SCAN: sums[SCAN]}})  # fmt: skip
    monkeypatch.setenv("XDG_CACHE_HOME", str(site.cache))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.chdir(tmp_path)
    scan = site.root / "YcbSoupCan" / "textured_simple_reoriented.obj"
    scan.parent.mkdir()
    scan.write_bytes(CONTENT[SCAN])
    site.pack({"cone/data.json": b"{}", **{file: CONTENT[file] for file in (VISUAL, COLLISION)}})
    yield site
    site.close()


@pytest.mark.parametrize("name", ["kubasic", "ycb"])
def test_a_set_is_fetched_once(site, name):
    said = []
    folder = public_folder(Path(name), lambda fraction, message: said.append(message))
    assert folder == site.cache / "sdfsim" / "public" / name
    assert {str(file.relative_to(folder)): file.read_bytes() for file in site.kept()} == {
        file: CONTENT[file] for file in public_shapes.SUMS[name]
    }
    assert len(said) == 1 and site.url in said[0]
    site.close()
    assert public_folder(Path(name)) == folder


def test_a_file_with_another_sum_is_refused_and_nothing_kept(site):
    site.pack({VISUAL: CONTENT[VISUAL], COLLISION: b"v 6 6 6\n"})
    with pytest.raises(SdfsimError, match=r"cone\.tar\.gz: collision_geometry\.obj: ") as caught:
        public_folder(Path("kubasic"))
    for content in (b"v 6 6 6\n", CONTENT[COLLISION]):
        assert hashlib.sha256(content).hexdigest() in caught.value.message
    assert not site.kept()


def test_a_path_in_an_archive_leads_nowhere(site, tmp_path):
    before = set(tmp_path.rglob("*"))
    site.pack({"../../../outside.obj": b"", str(tmp_path / "outside.obj"): b"", "../../" + VISUAL: CONTENT[VISUAL],
               "../" + COLLISION: CONTENT[COLLISION]})  # fmt: skip
    folder = public_folder(Path("kubasic"))
    assert sorted(site.kept()) == [folder / COLLISION, folder / VISUAL]
    assert {path for path in tmp_path.rglob("*") if not path.is_relative_to(site.cache)} == before


def test_without_a_network_it_says_what_to_put_where(site):
    site.close()
    folder = site.cache / "sdfsim" / "public" / "kubasic"
    with pytest.raises(SdfsimError, match=f"(?m)^{site.url}/cone.tar.gz: .*refused$") as caught:
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
