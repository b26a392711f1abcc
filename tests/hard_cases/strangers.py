"""Files as strangers write them: valid scenes with what they should become, and ways to spoil scenes and bytes."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import yaml
from hypothesis import strategies as st

# What a field takes, by the last key of its path ("[]" for the entries of a list).
NUMBERS = ("duration", "radius", "spacing", "offset", "scale", "mass", "density", "friction", "restitution", "time")
INTEGERS = ("version", "seed", "count", "resolution", "nodes")
VECTORS = ("gravity", "size", "position", "velocity", "angular_velocity", "normal", "grid", "euler_xyz_deg")

NOT_A_NUMBER = ("heavy", "'1'", "[1]", "{}", "null", "true", ".nan", "-.inf", "1e999", "0x10", "1_000", "1:30", "''")
NOT_AN_INTEGER = (*NOT_A_NUMBER, "1.5", "9" * 30)
NOT_A_VECTOR = ("3", "[1, 2]", "[1, 2, 3, 4, 5]", "[a, b, c]", "{x: 1}", "null", "[1, 2, .nan]", "[[1], 2, 3]", "up")
NOT_A_WORD = ("sideways", "[]", "{}", "null", "1", "true")
NOT_A_TEXT = ("[]", "{}", "null", "''", "' '")
NOT_A_MAPPING = ("3", "text", "[1]", "[]")
NOT_A_LIST = ("3", "text", "{}")

small = st.floats(-1e3, 1e3, allow_nan=False).map(lambda x: round(x, 4))
positive = st.floats(1e-3, 1e3).map(lambda x: round(x, 4))
vector = st.lists(small, min_size=3, max_size=3)
# Without line breaks that YAML's writer and reader do not agree about.
letters = st.characters(exclude_categories=["Cs", "Zl", "Zp"], exclude_characters="\x85")
names = st.text(letters, min_size=1, max_size=12).filter(str.strip)


def sometimes(**fields: st.SearchStrategy) -> st.SearchStrategy[dict]:
    """Some of the fields."""
    return st.fixed_dictionaries({}, optional=fields)


shapes = st.one_of(
    st.builds(lambda r: {"sphere": {"radius": r}}, positive),
    st.builds(lambda s: {"box": {"size": s}}, st.lists(positive, min_size=3, max_size=3)),
    st.builds(lambda more: {"asset": "crate", **more}, sometimes(sdf=st.just("mesh"))),
    st.builds(lambda more: {"mesh": "crate.obj", "sdf": "mesh", **more}, sometimes(units=st.sampled_from(["cm", "m"]))),
)


@st.composite
def _body(draw: st.DrawFn, name: str, shape: str) -> dict:
    body = {"name": name, "shape": shape}
    kind = draw(st.sampled_from(["dynamic", "static", "kinematic", "copies"]))
    body |= draw(sometimes(scale=positive, friction=positive, restitution=st.sampled_from([0, 0.25, 1])))
    if kind == "kinematic":
        path = [{"time": t, "position": draw(vector)} for t in range(draw(st.integers(1, 3)))]
        return body | {"motion": "kinematic", "path": path}
    body |= draw(sometimes(position=vector, euler_xyz_deg=vector))
    if kind == "static":
        return body | {"motion": "static"}
    body |= draw(sometimes(velocity=vector, angular_velocity=vector))
    body |= draw(st.sampled_from([{}, {"mass": 2.5}, {"density": 300}]))
    if kind == "copies":
        grid = draw(st.lists(st.integers(1, 3), min_size=3, max_size=3))
        body["arrange"] = {"grid": grid, "spacing": draw(positive)}
        body["count"] = draw(st.integers(1, int(np.prod(grid))))
    return body


@st.composite
def scenes(draw: st.DrawFn) -> dict:
    """A valid document, as plain data."""
    effects = sometimes(contact=st.sampled_from(["auto", "on", "off"]), sleep=st.sampled_from(["on", "off"]))
    document = {"version": 1} | draw(
        sometimes(duration=positive, seed=st.integers(0, 10**17), gravity=vector, effects=effects, model=st.just("gnn"))
    )
    named = draw(st.lists(names, min_size=1, max_size=3, unique=True))
    document["shapes"] = {name: draw(shapes) for name in named}
    called = draw(st.lists(names.filter(lambda n: "[" not in n), min_size=1, max_size=4, unique=True))
    bodies = [draw(_body(name, draw(st.sampled_from(named)))) for name in called[1:]]
    if bodies:
        bodies[0] |= draw(sometimes(collides_with=st.just([called[0]])))
    document["bodies"] = [
        {"name": called[0], "plane": draw(sometimes(normal=st.just([0, 1, 1]), offset=small))},
        *bodies,
    ]
    return document


class Spoiled(NamedTuple):
    """A text that must be refused, and what the fault's line has to name."""

    text: str
    field: str


def _places(node: yaml.Node, path: str = "") -> Iterator[tuple[yaml.Node, str]]:
    """Every node with its path as messages write it."""
    yield node, path
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            yield from _places(value, f"{path}.{key.value}" if path else key.value)
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            yield from _places(value, f"{path}[{index}]")


def _wrong_for(path: str, node: yaml.Node) -> tuple[str, ...]:
    """Values of the wrong type for the field at a path."""
    key = path.rsplit(".", 1)[-1]
    if key in ("asset", "mesh", "shape", "name"):
        return NOT_A_TEXT
    if path.startswith("effects.") or key in ("motion", "sdf", "units"):
        return NOT_A_WORD
    if key in INTEGERS:
        return NOT_AN_INTEGER
    if key in NUMBERS or (key.endswith("]") and isinstance(node, yaml.ScalarNode) and "collides" not in key):
        return NOT_AN_INTEGER if ".grid[" in path else NOT_A_NUMBER
    if key in VECTORS:
        return NOT_A_VECTOR
    if isinstance(node, yaml.SequenceNode):
        return NOT_A_LIST
    return NOT_A_MAPPING if isinstance(node, yaml.MappingNode) else ("[]", "{}")


_FREE = ("shapes",)  # mappings whose keys are names


@st.composite
def spoiled_scenes(draw: st.DrawFn) -> Spoiled:
    """A valid scene with one fault: a wrong type, an unknown key, a doubled key, a missing key, a foreign tag."""
    root = yaml.compose(yaml.safe_dump(draw(scenes()), allow_unicode=True, sort_keys=False))
    places = list(_places(root))
    mappings = [(node, path) for node, path in places if isinstance(node, yaml.MappingNode)]
    how = draw(st.sampled_from(["type", "type", "unknown", "doubled", "missing", "tag"]))
    if how == "type":
        node, path = draw(st.sampled_from(places[1:]))
        wrong = yaml.compose(draw(st.sampled_from(_wrong_for(path, node))))
        node.__class__ = wrong.__class__
        node.__dict__.update(wrong.__dict__)
        return Spoiled(yaml.serialize(root, allow_unicode=True), path)
    if how == "tag":
        node, path = draw(st.sampled_from(places))
        node.tag = draw(st.sampled_from(["!thing", "tag:yaml.org,2002:python/object/apply:os.getcwd"]))
        return Spoiled(yaml.serialize(root, allow_unicode=True), path)
    node, path = draw(st.sampled_from([place for place in mappings if place[1] not in _FREE]))
    dot = f"{path}." if path else ""
    if how == "unknown" or not node.value:
        key = draw(st.sampled_from(["colour", "postion", "<<", "Mass", "name ", "1", "null"]))
        node.value.append((yaml.ScalarNode("tag:yaml.org,2002:str", key), yaml.compose("1")))
        return Spoiled(yaml.serialize(root, allow_unicode=True), dot + key)
    required = [k for k, _ in node.value if k.value in ("version", "bodies", "name", "radius", "size", "grid", "time")]
    if how == "missing" and required:
        gone = draw(st.sampled_from(required))
        node.value = [(k, v) for k, v in node.value if k is not gone]
        return Spoiled(yaml.serialize(root, allow_unicode=True), path)
    key, value = draw(st.sampled_from(node.value))
    node.value.append((key, value))
    return Spoiled(yaml.serialize(root, allow_unicode=True), dot + key.value)


_SYNTAX = ("&a ", "*a", "{", "}", "[", "]", ": ", "- ", "\n", "  ", "'", '"', "!!", "|\n", ">", "? ", "<<: *a", "#")
_RARE = ("%YAML 1.1\n", "---\n", "...\n", "\t", "\x00", "\x85", "\u2028", "\ufeff", "1e400", "-", "~", "😀", "\u202e")
_PIECES = _SYNTAX + _RARE


@st.composite
def mangled_texts(draw: st.DrawFn) -> str:
    """A valid scene's text with pieces cut out, doubled, moved or put in; or text that never was one."""
    if draw(st.integers(0, 4)) == 0:
        return draw(st.one_of(st.text(max_size=200), st.lists(st.sampled_from(_PIECES), max_size=60).map("".join)))
    text = yaml.safe_dump(
        draw(scenes()), allow_unicode=True, default_flow_style=draw(st.sampled_from([None, True, False]))
    )
    for _ in range(draw(st.integers(1, 6))):
        start = draw(st.integers(0, len(text)))
        stop = min(len(text), start + draw(st.integers(0, 20)))
        put = draw(st.one_of(st.just(""), st.sampled_from(_PIECES), st.just(text[start:stop] * 2), st.text(max_size=4)))
        text = text[:start] + put + text[stop:]
    return text


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """TimeoutError in the block when it takes more time of the processor, however busy that is with other things."""

    def ring(*_: object) -> None:
        raise TimeoutError(f"took longer than {seconds} s")

    before = signal.signal(signal.SIGPROF, ring)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)
