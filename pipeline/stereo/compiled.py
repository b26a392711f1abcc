"""The compiled functions of stereo, kept in the user's cache folder."""

from sdfsim.physics import solver as kernels

with kernels.kept():
    from pipeline.stereo.kernels import agreeing as agreeing
    from pipeline.stereo.kernels import carve as carve
    from pipeline.stereo.kernels import paint as paint
    from pipeline.stereo.kernels import sweep as sweep
