"""What pyproject.toml cannot say: the samples are a folder beside the code, and in a wheel a part of it."""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["sdfsim*", "pipeline*"]), "sdfsim.samples"],
    package_dir={"sdfsim.samples": "samples"},
)
