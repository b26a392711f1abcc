"""A field sampled on a GPU."""

import numpy as np
import pytest
import torch

from pipeline.field.grid_field import GridField
from pipeline.mesh.extraction import field_colors, field_distance
from tests.helpers.fields import SMALL
from tests.helpers.surfaces import cube


@pytest.mark.gpu
def test_distances_and_colours_are_those_of_the_processor():
    field, points = GridField(SMALL), np.random.default_rng(0).uniform(-0.9, 0.9, (1000, 3))
    with torch.no_grad():
        distances, colors = field_distance(field)(points), field_colors(field, cube())
        field = field.to("cuda")
        np.testing.assert_allclose(field_distance(field)(points), distances, atol=1e-4)
        np.testing.assert_allclose(field_colors(field, cube()), colors, atol=1e-3)
