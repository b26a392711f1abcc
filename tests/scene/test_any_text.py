"""Whatever is written is a scene or a fault, never anything else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sdfsim import SceneError

VOCABULARY = """version 1 bodies shapes ball name a shape mass -1 .nan 1e400 plane normal offset count arrange grid
spacing position [0,0,1] collides_with all effects contact off sphere radius 0 &x *x {} [] ~ ! | > ' " - : ,"""
WORDS = st.sampled_from([*VOCABULARY.split(), "\n", "\n  "])


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(WORDS, max_size=40))
def test_whatever_is_written_ends_in_a_scene_or_a_scene_error(load, words):
    try:
        load(" ".join(words))
    except SceneError as error:
        assert error.problems and all("scene.yaml" in line for line in error.problems)


VALUES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=6),
    st.lists(st.floats() | st.integers(-3, 3), max_size=4),
    st.sampled_from([{}, {"grid": [1, 2, 3], "spacing": 0.1}, {"normal": [0, 0, 1]}, ["a"], "all", "ball", "static"]),
)
KEYS = st.sampled_from(
    "name shape plane motion scale position quat_xyzw quat_wxyz euler_xyz_deg velocity angular_velocity mass density "
    "friction restitution collides_with count arrange other".split()
)


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.dictionaries(KEYS, VALUES, max_size=5))
def test_any_body_is_a_body_or_a_fault(load, fields):
    import yaml

    body = {"name": "a", "shape": "ball", **fields}
    text = yaml.safe_dump({"version": 1, "shapes": {"ball": {"sphere": {"radius": 1}}}, "bodies": [body]})
    try:
        scene = load(text)
    except SceneError as error:
        assert error.problems
        return
    for b in scene.bodies:
        assert np.isfinite(b.position).all() and np.isfinite(b.mass) and b.scale > 0
        assert np.linalg.norm(b.quat_xyzw) == pytest.approx(1)
