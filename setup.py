"""What pyproject.toml cannot say: the samples are a folder beside the code, and in a wheel a part of it."""

from setuptools import find_namespace_packages, setup

ours = find_namespace_packages(include=["sdfsim*", "pipeline*"], exclude=["*__pycache__*"])
setup(packages=[*ours, "sdfsim.samples"], package_dir={"sdfsim.samples": "samples"})
