"""ppo.py and ppo_rgb.py stand alone, so that each can be copied: what both need is in both, and stays the same."""

import ast
import difflib
import re

from conftest import ROOT

import ppo_rgb

# what differs between the state and the images; everything else must not
DIFFERENT = {"Args", "make_env", "Agent", "check_observations", "prepare_rendering", "train"}
MOST_DIFFERENT_LINES_OF_TRAIN = 30


def inline_metadata(script):
    """The PEP 723 block of a script, without its comment signs."""
    block = re.search(r"^# /// script\n((?:#.*\n)+?)# ///$", script.read_text(), re.M).group(1)
    return "".join(line[2:] if line.startswith("# ") else line[1:] for line in block.splitlines(keepends=True))


def test_inline_metadata_equals_pyproject():
    try:
        import tomllib
    except ImportError:
        import tomli as tomllib
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for name in ("ppo.py", "ppo_rgb.py"):
        script = tomllib.loads(inline_metadata(ROOT / name))
        assert script == {k: project[k] for k in ("requires-python", "dependencies")}


def definitions(name):
    """Source of each function and class of a script, comments included."""
    source = (ROOT / name).read_text()
    nodes = [node for node in ast.parse(source).body if isinstance(node, (ast.FunctionDef, ast.ClassDef))]
    return {node.name: ast.get_source_segment(source, node) for node in nodes}


def test_shared_definitions_are_identical():
    state, images = definitions("ppo.py"), definitions("ppo_rgb.py")
    shared = state.keys() & images.keys()
    assert {name for name in shared if state[name] != images[name]} == DIFFERENT
    assert state.keys() - images.keys() == set(), "InertRenderObject is not at the top level"
    assert [name for name in images if name in shared] == list(state), "in the same order"


def test_the_loops_differ_by_the_observations_alone():
    a, b = [definitions(name)["train"].splitlines() for name in ("ppo.py", "ppo_rgb.py")]
    changed = [line for line in difflib.ndiff(a, b) if line[0] in "+-"]
    assert len(changed) <= MOST_DIFFERENT_LINES_OF_TRAIN, "\n".join(changed)


def test_flags_that_both_have_are_the_same():
    """Types and help, but for what a CPU or an image changes; and in the same order."""
    import ppo

    a, b = ppo.Args.__dataclass_fields__, ppo_rgb.Args.__dataclass_fields__
    assert [k for k in a if k in b] == [k for k in b if k in a]
    assert a.keys() - b.keys() == {"shared_features"}
    of_images = "include_state frame_stack camera_width camera_height encoder random_shift channels_last amp"
    assert b.keys() - a.keys() == set(of_images.split())
    other_defaults = {k for k in a.keys() & b.keys() if a[k].default != b[k].default}
    assert other_defaults == {"obs_mode", "num_envs", "render_mode", "shader"}
