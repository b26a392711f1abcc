"""Public shapes by name: fetched once into the user's cache folder, with every file checked by its SHA-256.

`kubasic` is the eleven bodies of MOVi-B, from Kubric's KuBasic assets (CC BY-SA 4.0, the Kubric authors). `ycb` is six
scans of the YCB object set (CC BY 4.0), reoriented as in the repository eleramp/pybullet-object-models; YCB's own site
has other files of the same objects.

public_shapes.sha256 holds the checksums of the files that the published figures were made from. An archive as a whole
is not checked, because packing it again does not change shapes.
"""

import hashlib
import tarfile
import tempfile
import zlib
from pathlib import Path

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import FREELY, user_cache, write_bytes
from sdfsim.base.parallel import Progress, silent

KUBRIC = "https://storage.googleapis.com/kubric-public/assets/KuBasic"
# One commit, so that the files cannot change.
YCB = (
    "https://raw.githubusercontent.com/eleramp/pybullet-object-models/92a8d73c817d5af3866743e92195a62d9449f92c"
    "/pybullet_object_models/ycb_objects"
)
ARCHIVE = ".tar.gz"
# For every set: its files, by their names in the set's folder, and their SHA-256.
SUMS: dict[str, dict[str, str]] = {}
for line in Path(__file__).with_suffix(".sha256").read_text(encoding="utf-8").splitlines():
    checksum, path = line.split()
    SUMS.setdefault(path.split("/")[0], {})[path.partition("/")[2]] = checksum


def public_folder(shapes: Path, on_progress: Progress = silent) -> Path:
    """The folder for `--shapes`: this path if it exists, else the public set of this name in `SUMS`, fetched if
    necessary. Raises SdfsimError if a download failed or a file is not the expected one."""
    name = str(shapes)
    if name not in SUMS or shapes.is_dir():
        return shapes
    folder = user_cache("public") / name
    hint = f"put these files into {folder} by hand: {', '.join(SUMS[name])}"
    missing = [file for file in SUMS[name] if not (folder / file).is_file()]
    for url in dict.fromkeys(map(_url, missing)):
        on_progress(0.0, f"fetching {url}")
        content = fetched(url, hint)
        found = {file: content.get(Path(file).name) or content.get("", b"") for file in missing if _url(file) == url}
        for file in found:  # check all files before any is kept
            _check(found[file], SUMS[name][file], f"{url}: {Path(file).name}", hint)
        for file in found:
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            write_bytes(folder / file, found[file])
    for file, expected in SUMS[name].items():  # users may have put it there, so it is checked each time
        _check((folder / file).read_bytes(), expected, str(folder / file), "remove it, and it is fetched again")
    return folder


def _url(file: str) -> str:
    """The address of a file of a set: Kubric's archive named after its folder, or the file itself."""
    if folder := Path(file).parent.name:
        return f"{KUBRIC}/{folder}{ARCHIVE}"
    return f"{YCB}/{Path(file).stem.title().replace('_', '')}/textured_simple_reoriented.obj"


def _check(content: bytes, expected: str, what: str, hint: str) -> None:
    if (got := hashlib.sha256(content).hexdigest()) != expected:
        raise SdfsimError(f"{what}: not the expected file: SHA-256 {got}, not {expected}", hint)


def fetched(url: str, hint: str, inside: str = "", kept: Path | None = None) -> dict[str, bytes]:
    """The files of an archive by their base names (so paths in it do not matter), from all folders or only from those
    named `inside`; a single file has the name "". `kept` is where users may have put it. Raises SdfsimError if it
    cannot be fetched."""
    import pooch

    pooch.get_logger().setLevel("WARNING")  # it would log the checksum of each download
    try:
        with tempfile.TemporaryDirectory() as scratch:
            if kept is not None and kept.is_file():
                file = kept
            else:
                file = Path(pooch.retrieve(url, known_hash=None, fname="download", path=scratch))
            if ARCHIVE[1:] not in url:
                return {"": file.read_bytes()}
            with tarfile.open(file, "r:gz") as archive:
                members = [member for member in archive if member.isfile() and member.size <= FREELY]
                members = [member for member in members if inside in ("", Path(member.name).parent.name)]
                opened = ((Path(member.name).name, archive.extractfile(member)) for member in members)
                return {name: content.read() for name, content in opened if content is not None}
    except (OSError, EOFError, tarfile.TarError, zlib.error) as error:
        reason: BaseException = error
        while reason.__context__ is not None:  # the first cause is short, such as "Name or service not known"
            reason = reason.__context__
        raise SdfsimError(f"{url}: cannot be fetched: {reason}", hint) from error
