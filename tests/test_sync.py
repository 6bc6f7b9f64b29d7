"""ppo.py and ppo_rgb.py stand alone, so that each can be copied. Code that both need is in both, and must be equal."""

import ast
import difflib
import re

import pytest
from conftest import ROOT

import ppo_rgb

# what differs between the state and the images; everything else must be equal
DIFFERENT = {
    "EnvironmentArgs", "PPOArgs", "make_env", "Agent", "check_observations", "check_task",
    "load_agent", "num_update_threads", "rollout", "train",
}  # fmt: skip
DIFFERENT_CONSTANTS = {"CPU_DEFAULTS", "FIXED_FLAGS", "LIMITS"}
DIFFERENT_HELP = {"obs_mode", "render_backend", "render_mode", "shader", "env_kwargs", "norm_obs"}
MOST_DIFFERENT_LINES = {"rollout": 12, "train": 17}


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


def definitions(name, kinds=(ast.FunctionDef, ast.ClassDef)):
    """Source of what a script defines at its top level, comments and decorators included."""
    source = (ROOT / name).read_text()
    found = {}
    for node in ast.parse(source).body:
        if isinstance(node, kinds):
            key = ast.unparse(node.targets[0]) if isinstance(node, ast.Assign) else node.name
            first = min([node.lineno, *(d.lineno for d in getattr(node, "decorator_list", ()))])
            found[key] = "\n".join(source.splitlines()[first - 1 : node.end_lineno])
    return found


def test_shared_definitions_are_identical():
    state, images = definitions("ppo.py"), definitions("ppo_rgb.py")
    shared = state.keys() & images.keys()
    assert {name for name in shared if state[name] != images[name]} == DIFFERENT
    assert list(state) == [name for name in images if name in shared], "all of them, in the same order"
    state, images = definitions("ppo.py", ast.Assign), definitions("ppo_rgb.py", ast.Assign)
    assert {name for name in state if state[name] != images.get(name)} == DIFFERENT_CONSTANTS


@pytest.mark.parametrize("name", MOST_DIFFERENT_LINES)
def test_the_loops_differ_by_the_observations_alone(name):
    a, b = [definitions(script)[name].splitlines() for script in ("ppo.py", "ppo_rgb.py")]
    changed = [line for line in difflib.ndiff(a, b) if line[0] in "+-"]
    assert len(changed) <= MOST_DIFFERENT_LINES[name], "\n".join(changed)


def flags(name):
    """(type, default, help) of each flag of a script."""
    groups = [x for x in ast.parse((ROOT / name).read_text()).body if getattr(x, "name", "").endswith("Args")]
    return {
        field.target.id: (ast.unparse(field.annotation), ast.unparse(field.value), text.value.value)
        for group in groups
        for field, text in zip(group.body, group.body[1:])
        if isinstance(field, ast.AnnAssign)
    }


def test_flags_that_both_have_are_the_same():
    """Shared flags have the same order, types, defaults and help, except where images require something else."""
    a, b = flags("ppo.py"), flags("ppo_rgb.py")
    assert [k for k in a if k in b] == [k for k in b if k in a] and b.keys() == ppo_rgb.Args.__dataclass_fields__.keys()
    assert a.keys() - b.keys() == {"shared_features"}
    of_images = "include_state frame_stack camera_width camera_height encoder random_shift channels_last amp"
    assert b.keys() - a.keys() == set(of_images.split())
    shared = a.keys() & b.keys()
    assert {k for k in shared if a[k][0] != b[k][0]} == {"shader"}
    assert {k for k in shared if a[k][1] != b[k][1]} == {"obs_mode", "num_envs", "target_kl", "render_mode", "shader"}
    assert {k for k in shared if a[k][2] != b[k][2]} == DIFFERENT_HELP
