"""The compiled functions of stereo, kept in the user's cache folder."""

from pathlib import Path

from sdfsim.base.compiling import cache_of, kept

with kept(cache_of([Path(__file__).with_name("kernels.py")])):
    from pipeline.stereo.kernels import agreeing as agreeing
    from pipeline.stereo.kernels import carve as carve
    from pipeline.stereo.kernels import paint as paint
    from pipeline.stereo.kernels import sweep as sweep
