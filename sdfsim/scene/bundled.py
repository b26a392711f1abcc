"""The sample scenes that come with the package, by name: `pile` is as good as the path of `pile.yaml`."""

import shutil
from pathlib import Path

from sdfsim.base.errors import SdfsimError, nearest


def sample_folder() -> Path:
    """The folder of the samples: in the installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    return next(folder for folder in (package / "samples", package.parent / "samples") if folder.is_dir())


def samples() -> dict[str, str]:
    """What each sample scene shows, by the sample's name: the comment in its first line."""
    lines = {}
    for file in sorted(sample_folder().glob("*.yaml")):
        with file.open(encoding="utf-8") as opened:
            lines[file.stem] = opened.readline().lstrip("# ").rstrip(" :\n")
    return lines


def find_scene(given: Path | str, *, or_run: bool = False) -> Path:
    """The scene file for a path, or for the name of a sample if there is no file of that name. Raises SdfsimError if it
    is neither; with `or_run` the message says that a run folder or Shape folder would have been accepted too."""
    path = Path(given)
    if path.suffix or len(path.parts) != 1 or path.is_file():
        return path
    known = samples()
    if path.name not in known:
        if or_run:
            message = f"{path}: no run folder, Shape folder, scene file or sample has this name"
            raise SdfsimError(message + nearest(path.name, known), "sdfsim samples lists the samples")
        message = f"{path}: neither a scene file nor a sample{nearest(path.name, known)}"
        raise SdfsimError(message, f"give a scene.yaml, or one of {', '.join(known)}")
    return sample_folder() / f"{path.name}.yaml"


def copy_samples(out: Path) -> Path:
    """Copy all samples, with their shapes, photos and scripts, to a new folder. Raises SdfsimError if the folder exists
    or cannot be written."""
    if out.exists():
        raise SdfsimError(f"{out}: exists already, and is not replaced", "choose another -o")
    try:
        shutil.copytree(sample_folder(), out, ignore=shutil.ignore_patterns("__pycache__"))
    except OSError as error:
        raise SdfsimError(f"{out}: cannot be written: {error}", "choose another -o") from error
    return out
