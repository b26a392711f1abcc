"""The report of the command info: versions, devices, models; what is missing, what it is for, and how to get it."""

import importlib
import platform
import re
from importlib import metadata
from typing import Any

from sdfsim.apps.viewer import has_screen, viewer_program
from sdfsim.base.compiling import is_compiled
from sdfsim.base.errors import SdfsimError
from sdfsim.base.version import __version__
from sdfsim.learned.model import model_names

# Packages whose versions are reported; every required package is checked.
NEEDED = ("torch", "numpy", "scipy", "numba", "open3d", "trimesh", "pycolmap", "opencv-python-headless", "rerun-sdk")
# Packages of extras: the extra, and what it is for.
EXTRAS = {
    "usd-core": ("export", "export of .usd"),
    "coacd": ("export", "convex pieces, which .xml and .urdf need for shapes without any"),
    "pybullet": ("data", "training data, and comparisons with PyBullet"),
    "mujoco": ("export", "import of MJCF, and comparisons with MuJoCo"),
    "matplotlib": ("bench", "plots of tradeoff and stress, the picture of identify"),
    "imagecodecs": ("record3d", "depth of Record3D"),
    "OpenEXR": ("record3d", "depth of Record3D, in its other form"),
    "distributed": ("learn", "work on a Dask cluster"),
}
# System libraries that packages load, and their Debian packages.
LIBRARIES = {
    "libGL.so.1": "libgl1", "libEGL.so.1": "libegl1", "libX11.so.6": "libx11-6", "libudev.so.1": "libudev1",
    "libusb-1.0.so.0": "libusb-1.0-0", "libgomp.so.1": "libgomp1",
}  # fmt: skip


def about() -> dict[str, Any]:
    """Versions, devices, models, and in `missing` one line for each thing that is missing."""
    versions = {"sdfsim": __version__, "python": platform.python_version(), "system": platform.platform(terse=True)}
    versions |= {name: _version(name) or "missing" for name in (*NEEDED, *EXTRAS)}
    missing = [f"{name}: pip install {name}" for name in _needed() if _version(name) is None]
    devices, threads = ["cpu"], None
    for module in ("torch", "open3d"):
        try:
            found: Any = importlib.import_module(module)
        except (ImportError, OSError) as error:
            missing.append(_unloaded(module, str(error)))
            continue
        if module == "torch":
            devices += [f"cuda:{k} {found.cuda.get_device_name(k)}" for k in range(found.cuda.device_count())]
            threads = found.get_num_threads()
    if len(devices) == 1:
        missing.append("a CUDA device, for fast training: everything else runs without it")
    for name, (extra, use) in EXTRAS.items():
        if versions[name] == "missing":
            missing.append(f"{name}, for {use}: pip install 'sdfsim[{extra}]'")
    try:
        viewer_program()
    except SdfsimError as error:
        missing.append(f"the viewer of recordings: {error.hint}")
    if not has_screen():
        missing.append("a screen: use the browser (view --web), or render movies and pictures")
    if not _compiled():
        missing.append("the compiled contact step: the first run compiles it, in about a minute")
    return {
        "versions": versions, "devices": devices, "cpu_threads": threads, "models": model_names(), "missing": missing,
    }  # fmt: skip


def about_lines(report: dict[str, Any]) -> list[str]:
    lines = [f"{name} {version}" for name, version in report["versions"].items() if version != "missing"]
    lines += [f"devices: {', '.join(report['devices'])}", f"models: {', '.join(report['models'])}"]
    return [*lines, *(f"not here: {line}" for line in report["missing"])]


def _needed() -> list[str]:
    """The packages that the project requires, without extras."""
    try:
        asked = metadata.requires("sdfsim") or []
    except metadata.PackageNotFoundError:  # a checkout that is not installed
        return list(NEEDED)
    return [re.split(r"[^\w.-]", one)[0] for one in asked if "extra ==" not in one]


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _unloaded(module: str, why: str) -> str:
    """The line for a module that does not load, from the system's message."""
    lacking = re.search(r"lib[\w.+-]+\.so[\w.]*", why)
    if lacking and lacking[0] in LIBRARIES:
        return f"{lacking[0]}, which {module} loads: apt-get install {LIBRARIES[lacking[0]]}"
    return f"{module} does not load: {' '.join(why.split())[:200]}"


def _compiled() -> bool:
    from sdfsim.physics.solver.run import run_steps

    return is_compiled(run_steps)
