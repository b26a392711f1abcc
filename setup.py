"""What pyproject.toml cannot say: the samples are a folder beside the code, and in a wheel a part of it."""

from pathlib import Path

from setuptools import find_namespace_packages, setup

ours = find_namespace_packages(include=["sdfsim*", "pipeline*"], exclude=["*__pycache__*"])
# Folders of data are named too, or setuptools warns of each at length; `photos` itself has scripts that stay out.
data = [folder for name in ("learn", "photos/table_vase", "shapes") for folder in Path("samples", name).rglob("")]
samples = ["sdfsim.samples", *(".".join(("sdfsim", *folder.parts)) for folder in data)]
setup(packages=[*ours, *samples], package_dir={"sdfsim.samples": "samples"})
