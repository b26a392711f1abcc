"""Public shapes by name: fetched once into the user's cache folder, every file checked by its SHA-256.

`kubasic` is the eleven bodies of MOVi-B, from Kubric's KuBasic assets (CC BY-SA 4.0, the Kubric authors). `ycb` is six
scans of the YCB object set (CC BY 4.0), as the repository eleramp/pybullet-object-models has reoriented them: YCB's own
site offers the same objects in other files.

The sums are those of the files that the published figures were made from. An archive as a whole is not checked:
packing it anew changes no shape.
"""

from __future__ import annotations

import hashlib
import tarfile
import tempfile
import zlib
from pathlib import Path

from sdfsim.errors import SdfsimError
from sdfsim.files import FREELY, user_cache, write_bytes
from sdfsim.parallel import Progress, silent

KUBRIC = "https://storage.googleapis.com/kubric-public/assets/KuBasic"
# One commit, so that nothing there can move.
YCB = (
    "https://raw.githubusercontent.com/eleramp/pybullet-object-models/92a8d73c817d5af3866743e92195a62d9449f92c"
    "/pybullet_object_models/ycb_objects"
)
ARCHIVE = ".tar.gz"
# Of every set: its files, as they lie in the set's folder, and their SHA-256.
SUMS = {
    "kubasic": {
        "cone/visual_geometry.obj": "a5bb85a5083e3b0e644acdcb4355bdf17a2fb8b3ec8d006bc8955ea6cf0ef983",
        "cone/collision_geometry.obj": "de2a2c2bc742bace10e25c78cdddddeb49c9aff5d2f82f3fd5952a09348ad171",
        "cube/visual_geometry.obj": "5eca831005f71c7994152820ca99af9381a22a5704d1de755ad2718b572dd3b7",
        "cube/collision_geometry.obj": "3cf6780cff4fe1a8156dd442cc943067e704f9436355655567acbb143a727f4e",
        "cylinder/visual_geometry.obj": "96122a88977a7919a595e45ec178b8d4bb489da4a6bae827cf558278976aa0e7",
        "cylinder/collision_geometry.obj": "96ccec6bd37f843acacf690106d66c54b606f7e055f626581e04e0ce1f54965f",
        "gear/visual_geometry.obj": "5ad916a4472d10f792496fba24fc1800dd4bde89008d09abbbc34d8cd9f3e072",
        "gear/collision_geometry.obj": "e68f98add410359408885710c9690a4bd59778e149ee282073ae108c6cf2ea7c",
        "sphere/visual_geometry.obj": "a2a6ef8ca079fb960db9cd8e465f701fee3ff6adbaad1f5ea7253deac23d703e",
        "sphere/collision_geometry.obj": "96a605690ddc8eda2cce2f5245537d4a8ebc3c7866f415f159fa7cd634c72307",
        "sponge/visual_geometry.obj": "2a4835aa062ad4f2d249f42d3dfd7e696f2ad8191377a868eefeb5724e263cdc",
        "sponge/collision_geometry.obj": "a154ee2060f643e522a5f78a1016e7970f24d6e0f58afc040fe8af3927992cb0",
        "spot/visual_geometry.obj": "80ee429ad8633692248713c60efa57c3eadc8dc020abe326f8f0bd18353e849f",
        "spot/collision_geometry.obj": "3e761ded81a8c69d5d8462b5eb8a45a4166d64f6bf53ae762a8ddabc8286a5fc",
        "suzanne/visual_geometry.obj": "fb84550aab93739eb992653931047c59889608f16dbbd0916c71d5fdebda528f",
        "suzanne/collision_geometry.obj": "eb145c75aab68a71616ec4a9b8c9adfc508795dc65ca736fb699e10f342920f1",
        "teapot/visual_geometry.obj": "cb97775ab91aa6dbd847e6b4eaa32f6c9c65b4c0c1ecffdb17da62ae4fbd8358",
        "teapot/collision_geometry.obj": "8c25f84d4eea68cdbc65dbc817480c2ad0553e72fee6a9d193091418a4d9d741",
        "torus/visual_geometry.obj": "9d5cdce39d6dd13279e4b6984f38a4f4f0329d315e4ce0d44b2bb3147a7bb140",
        "torus/collision_geometry.obj": "24f171da80765d3c74da06553cec7e928f20874ae8b9d43bc8e7e1db73a4b062",
        "torus_knot/visual_geometry.obj": "c1c2a2147d077547220dcd89a63f5ceae33acde9bfdd664357e2bad2d7fe8100",
        "torus_knot/collision_geometry.obj": "e3957dcbb790e293ae490513266f2304b9eb908a6a2af2e5b3a1d0b51c8ecdab",
    },
    "ycb": {
        "ycb_banana.obj": "ee31f11cd1d5b07d84e50761873abe7fbc53de76b5b01fa286935198ad0d49cb",
        "ycb_cracker_box.obj": "ed49124153fc37d69346c29a36484515b49b2a3c37656a385f19876a416ca368",
        "ycb_mustard_bottle.obj": "f495746e5638ce392f865058970d99ad8b0bb1842d70d0825e5a9b2e933bebd1",
        "ycb_potted_meat_can.obj": "b957322daa655f4f70c8d25c758a6ce6a4c0037dd8e2e9fa08c191e553888e47",
        "ycb_scissors.obj": "c908f454bbc837f101ea06b147e82cb07dd86e27bc2c4cc25ca00505eb181e01",
        "ycb_tomato_soup_can.obj": "563caec7edab869d95f860f4459b816e362fc61e1b745ea89695ce830733d486",
    },
}


def public_folder(shapes: Path, on_progress: Progress = silent) -> Path:
    """The folder that `--shapes` means: of this path, else the public set of this name in `SUMS`, fetched if need be.
    Raises SdfsimError where a download failed or a file is not the one expected."""
    name = str(shapes)
    if name not in SUMS or shapes.is_dir():
        return shapes
    folder = user_cache("public") / name
    missing: dict[str, list[str]] = {}
    for file, expected in SUMS[name].items():
        if (folder / file).is_file():  # people may have put it there, so it is checked each time
            _check((folder / file).read_bytes(), expected, str(folder / file), "remove it, then it is fetched again")
        else:
            missing.setdefault(_url(file), []).append(file)
    hint = f"put these files into {folder} by hand: {', '.join(SUMS[name])}"
    for url, files in missing.items():
        on_progress(0.0, f"fetching {url}")
        found = _fetched(url, hint)
        content = {file: found.get(Path(file).name) or found.get("", b"") for file in files}
        for file in files:  # all of them before any is kept
            _check(content[file], SUMS[name][file], f"{url}: {Path(file).name}", hint)
        for file in files:
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            write_bytes(folder / file, content[file])
    return folder


def _url(file: str) -> str:
    """Where a file of a set is: in Kubric's archive of its folder's name, or by itself."""
    if folder := Path(file).parent.name:
        return f"{KUBRIC}/{folder}{ARCHIVE}"
    return f"{YCB}/{Path(file).stem.title().replace('_', '')}/textured_simple_reoriented.obj"


def _check(content: bytes, expected: str, what: str, hint: str) -> None:
    if (got := hashlib.sha256(content).hexdigest()) != expected:
        raise SdfsimError(f"{what}: another file than expected: SHA-256 {got}, not {expected}", hint)


def _fetched(url: str, hint: str) -> dict[str, bytes]:
    """The files of an archive by their last names alone, so that no path in it decides anything; a single one by ""."""
    import pooch

    pooch.get_logger().setLevel("WARNING")  # it would tell the sum of each download
    try:
        with tempfile.TemporaryDirectory() as scratch:
            file = Path(pooch.retrieve(url, known_hash=None, fname="download", path=scratch))
            if not url.endswith(ARCHIVE):
                return {"": file.read_bytes()}
            with tarfile.open(file, "r:gz") as archive:
                members = [member for member in archive if member.isfile() and member.size <= FREELY]
                opened = ((Path(member.name).name, archive.extractfile(member)) for member in members)
                return {name: content.read() for name, content in opened if content is not None}
    except (OSError, EOFError, tarfile.TarError, zlib.error) as error:
        reason: BaseException = error
        while reason.__context__ is not None:  # the first cause is short: "Name or service not known"
            reason = reason.__context__
        raise SdfsimError(f"{url}: cannot be fetched: {reason}", hint) from error
