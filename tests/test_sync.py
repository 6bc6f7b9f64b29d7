"""ppo.py and ppo_rgb.py stand alone, so that each can be copied. What both need is in both, and must be equal."""

import ast
import re
from dataclasses import fields

from conftest import ROOT
from sync import BANNER, shared_parts

import ppo
import ppo_rgb

# what differs above the banner; everything else that both have there must be equal
DIFFERENT = {"Args", "Agent", "check_observations", "make_env", "rollout", "update_minibatch"}
DIFFERENT_CONSTANTS = {"CPU_DEFAULTS", "GPU_BATCH_SIZE", "NUM_ITERATIONS", "FIXED_FLAGS", "LIMITS"}
DIFFERENT_CONSTANTS |= {"UPDATE_THREADS_PER_CORE", "MIN_CPU_ENVS", "(CPU_ENVS_PER_CORE, MAX_CPU_ENVS)"}
DIFFERENT_HELP = {"obs_mode", "render_backend", "render_mode", "shader", "env_kwargs", "norm_obs", "total_timesteps"}


def source(name):
    return (ROOT / name).read_text()


def inline_metadata(script):
    """The PEP 723 block of a script, without its comment signs."""
    block = re.search(r"^# /// script\n((?:#.*\n)+?)# ///$", script, re.M).group(1)
    return "".join(line[2:] if line.startswith("# ") else line[1:] for line in block.splitlines(keepends=True))


def test_inline_metadata_equals_pyproject():
    try:
        import tomllib
    except ImportError:
        import tomli as tomllib
    project = tomllib.loads(source("pyproject.toml"))["project"]
    for name in ("ppo.py", "ppo_rgb.py"):
        script = tomllib.loads(inline_metadata(source(name)))
        assert script == {k: project[k] for k in ("requires-python", "dependencies")}


def test_imports_and_machinery_are_the_same_bytes():
    for state, images in zip(shared_parts(source("ppo.py")), shared_parts(source("ppo_rgb.py"))):
        assert state == images, "run: python tests/sync.py"


def definitions(name, kinds):
    """Source of what a script defines above the banner, by name."""
    text = source(name).partition(BANNER)[0]
    found = {}
    for node in ast.parse(text).body:
        if isinstance(node, kinds):
            key = ast.unparse(node.targets[0]) if isinstance(node, ast.Assign) else node.name
            found[key] = ast.get_source_segment(text, node)
    return found


def test_other_definitions_differ_by_the_observations_alone():
    for kinds, different in (((ast.FunctionDef, ast.ClassDef), DIFFERENT), (ast.Assign, DIFFERENT_CONSTANTS)):
        state, images = definitions("ppo.py", kinds), definitions("ppo_rgb.py", kinds)
        shared = state.keys() & images.keys()
        assert shared == state.keys() and {name for name in shared if state[name] != images[name]} == different
        assert list(state) == [name for name in images if name in shared], "in the same order"


def help_texts(name):
    (args,) = [x for x in ast.parse(source(name)).body if getattr(x, "name", "") == "Args"]
    return {
        field.target.id: text.value.value
        for field, text in zip(args.body, args.body[1:])
        if isinstance(field, ast.AnnAssign)
    }


def test_flags_that_both_have_are_the_same():
    """Shared flags have the same order, types, defaults and help, except where images require something else."""
    a, b = [{field.name: field for field in fields(script.Args)} for script in (ppo, ppo_rgb)]
    assert [k for k in a if k in b] == [k for k in b if k in a]
    assert not a.keys() - b.keys()
    of_images = "include_state frame_stack camera_width camera_height encoder random_shift channels_last amp"
    assert b.keys() - a.keys() == set(of_images.split())
    shared = a.keys() & b.keys()
    assert {k for k in shared if a[k].type != b[k].type} == {"shader"}
    different = {"obs_mode", "num_envs", "render_mode", "shader", "learning_rate", "anneal_lr", "gamma", "gae_lambda"}
    different |= {"num_minibatches", "update_epochs", "target_kl", "desired_kl", "norm_obs", "logstd_lr_factor"}
    different |= {"staggered_resets"}
    assert {k for k in shared if a[k].default != b[k].default} == different
    x, y = help_texts("ppo.py"), help_texts("ppo_rgb.py")
    assert x.keys() == a.keys() and y.keys() == b.keys(), "every flag has a help text"
    assert {k for k in shared if x[k] != y[k]} == DIFFERENT_HELP


def test_sizes():
    """What one reads before the banner, and the largest function, stay within what design allows."""
    above = {name: source(name).partition(BANNER)[0].count("\n") for name in ("ppo.py", "ppo_rgb.py")}
    assert above["ppo.py"] < 720 and above["ppo_rgb.py"] <= above["ppo.py"] + 230
    for node in ast.walk(ast.parse(source("ppo.py"))):
        if isinstance(node, ast.FunctionDef) and node.name != "train":
            assert node.end_lineno - node.lineno < 60, node.name
