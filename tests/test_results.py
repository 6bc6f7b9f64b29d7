"""tests/benchmarks/results.py: the table of what PPO reaches."""

import json
import shlex
import shutil
from dataclasses import asdict

import pytest
import torch
from benchmarks import results
from conftest import ROOT, read_metrics

import ppo
import ppo_rgb

FLAGS = "--total_timesteps 640 --num_envs 4 --num_steps 40 --eval_freq 2 --num_eval_episodes 2 --num_actors 1"


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A project with the script and the recipes alone, so that runs go there. Evaluations are short, and run in this
    process: imports take longer."""
    (tmp_path / "examples").mkdir()
    for name in ("ppo.py", "examples/recipes.sh"):
        shutil.copy(ROOT / name, tmp_path / name)
    (tmp_path / "README.md").write_text(f"before\n{results.TABLE_STARTS}\nold\n{results.TABLE_ENDS}\nafter\n")
    monkeypatch.setattr(results, "ROOT", tmp_path)
    monkeypatch.setattr(results, "EVALUATION", [x.replace("256", "3") for x in results.EVALUATION])
    monkeypatch.chdir(tmp_path)

    def run(*command):
        if "--physics_alone" in command:
            return "1000\n"
        assert command[:2] == ("python", "ppo.py") and ppo.main([*command[2:]]) == 0

    monkeypatch.setattr(results, "run_script", run)
    monkeypatch.setattr("signal.signal", lambda *args: None)  # a thread may not set handlers
    return tmp_path


@pytest.mark.slow
def test_a_row_of_the_table(project, capsys):
    out = project / "results.jsonl"
    command = ["--recipes", "push_cube_cpu", "--seeds", "2", "--out", str(out), f"--flags={FLAGS}"]
    results.main(command)
    (row,) = map(json.loads, out.read_text().splitlines())
    assert (row["recipe"], row["task"], row["seed"], row["steps"]) == ("push_cube_cpu", "PushCube-v1", 2, 640)
    assert row["further_flags"] == shlex.join(shlex.split(FLAGS)) and row["flags"]["num_steps"] == 40
    assert row["versions"].keys() >= {"torch", "mani-skill", "sapien"} and "CPU" in row["hardware"] and row["commit"]
    for policy in ("best", "last"):
        mean, low, high = row[policy]["success_once"]
        assert 0 <= low <= mean <= high <= 1
        assert row[policy]["return"][0] > 0 and row[policy]["episode_len"][0] == 50

    (run_dir,) = (project / "runs").iterdir()
    trained = [x["rollout_time"] + x["update_time"] for x in read_metrics(run_dir) if x["kind"] == "train"]
    assert row["training_seconds"] == pytest.approx(sum(trained), abs=0.1)
    assert [steps for steps, *_ in row["curve"]] == [0, 320, 640] and row["physics_alone"] == 1000
    assert all(0 <= at_end <= once <= 1 for _, _, once, at_end in row["curve"])

    results.main(command)  # the row is there
    assert out.read_text().count("\n") == 1
    modified = (run_dir / "last.pt").stat().st_mtime
    with pytest.raises(SystemExit, match="0"):  # so is the run
        results.train(["ppo.py"], "push_cube_cpu", 2, shlex.split(FLAGS), 1)
    assert (run_dir / "last.pt").stat().st_mtime == modified

    results.main([*command, "--table"])
    assert "1 tasks; every seed solves 0 at some step, and 0 at the end" in capsys.readouterr().out
    before, _, _, header, _, line, _, _, after = (project / "README.md").read_text().splitlines()
    assert (before, after) == ("before", "after") and line.count("|") == header.count("|")
    assert not (project / "results.png").exists(), "nothing was learned in 640 steps"


@pytest.mark.slow
def test_a_recipe_may_start_from_the_policy_of_another(project, monkeypatch):
    flags = shlex.split(FLAGS)
    monkeypatch.setattr(results, "STARTS_FROM", {"push_cube_cpu": ("pull_cube_cpu", flags)})
    row = results.make_row("push_cube_cpu", 2, flags, 1)
    first = torch.load(project / row["flags"]["checkpoint"])
    assert (first["args"]["env_id"], first["args"]["seed"], first["finished"]) == ("PullCube-v1", 2, True)
    assert (row["task"], row["steps"]) == ("PushCube-v1", 640)


def make_row(recipe, seed, success=None, reward=0.5, at_end=0.0):
    metrics = dict(episode_len=[1000.0])
    metrics["return"] = [1000 * reward, 0.0, 1000.0]
    if success is not None:
        metrics |= dict(success_once=[success, 0.0, 1.0], success_at_end=[at_end, 0.0, 1.0])
    highest = metrics[results.main_metric(metrics)][0]
    curve = [[100 * i, 60.0 * i, highest * i / 2] for i in range(3)]
    return dict(
        recipe=recipe, further_flags="", seed=seed, task=recipe, steps=200, training_seconds=0.2, runs_at_once=seed,
        physics_alone=2000, best=metrics, last=metrics, steps_to_nine_tenths_of_the_best=100, curve=curve,
    )  # fmt: skip


@pytest.fixture
def path(tmp_path):
    """A file for the table."""
    path = tmp_path / "README.md"
    path.write_text(f"{results.TABLE_STARTS}\n{results.TABLE_ENDS}\n")
    return path


def test_a_task_is_solved_if_every_seed_solves_it(path, capsys):
    """By success where the task has it, else by the return."""
    rows = [make_row("push_cube_cpu", seed, success) for seed, success in ((2, 0.95), (1, 0.9), (3, 0.91))]
    rows += [make_row("push_cube_sb3", seed, 1.0, at_end=1.0) for seed in (1, 2, 3)]  # bold, but no task of ours
    rows += [make_row("pull_cube_cpu", seed, 1.0, at_end=at_end) for seed, at_end in ((1, 0.9), (2, 0.95), (3, 1.0))]
    rows += [make_row("pick_cube_cpu", seed, success) for seed, success in ((1, 0.95), (2, 0.89), (3, 1))]
    rows += [make_row("lift_peg_upright_cpu", seed, 1.0) for seed in (1, 2)]  # a seed is missing
    rows += [make_row("cartpole_balance_cpu", seed, reward=0.81) for seed in (1, 2, 3)]
    rows += [make_row("hopper_stand_cpu", seed, reward=0.79) for seed in (1, 2, 3)]
    results.write_table(rows, path)
    assert "every seed solves 3 at some step, and 2 at the end" in capsys.readouterr().out
    bold = [line for line in path.read_text().splitlines() if "**" in line]
    assert len(bold) == 4 and "| **0.90, 0.95, 0.91** | 0.00, 0.00, 0.00 |" in bold[0] and "`push_cube_sb3`" in bold[1]
    assert "| **1.00, 1.00, 1.00** | **0.90, 0.95, 1.00** |" in bold[2] and "| **810, 810, 810** |" in bold[3]
    assert bold[0].endswith("| 100 | 1,000 | 0.50 |")


def test_each_recipe_is_followed_by_its_peers():
    recipes = results.find_recipes()
    at = recipes.index("push_cube_cpu")
    assert recipes[at : at + 3] == ["push_cube_cpu", "push_cube_maniskill", "push_cube_sb3"]
    assert len(recipes) == len(set(recipes)) and recipes[at + 3] == "pull_cube_cpu"


def test_the_picture_has_what_learns(tmp_path):
    rows = [make_row("push_cube_cpu", seed, 1.0) for seed in (1, 2)] + [make_row("push_cube_sb3", 1, 1.0)]
    rows += [make_row("stack_cube_cpu", seed, 0.0, reward=0.0) for seed in (1, 2)]
    results.draw_curves(rows, tmp_path / "results.png")
    assert (tmp_path / "results.png").stat().st_size > 10_000


def test_steps_are_given_only_where_every_run_learned(path):
    """Else the table would give the step of an evaluation that was better by chance."""
    rates = [make_row("push_cube_cpu", seed, 0.5) for seed in (1, 2)]
    returns = [make_row("cartpole_balance_cpu", seed) for seed in (1, 2)]
    for rows, first, too_little, enough in ((rates, 0.0, 0.19, 0.2), (returns, 300, 499, 500)):
        rows[1]["curve"] = [[0, 0.0, first], [100, 60.0, too_little]]
        results.write_table(rows, path)
        assert "| 100 |" not in path.read_text()
        rows[1]["curve"][1][2] = enough
        results.write_table(rows, path)
        assert "| 100 |" in path.read_text()


def test_peers_have_the_steps_and_the_evaluations_of_the_recipe():
    """ManiSkill's own flags differ in all else, and Stable-Baselines3 has its defaults."""
    names = ("env_id", "total_timesteps", "num_eval_episodes")
    for name in results.COMPARED:
        script, *flags = results.find_command(f"{name}_cpu")
        own = ppo.parse_args(flags)
        interval = own.eval_freq * own.batch_size

        script, *flags = results.find_command(f"{name}_sb3")
        given = dict(zip(flags[::2], flags[1::2]))
        assert (results.ROOT / script).exists() and given.pop("--eval_interval") == str(interval)
        assert given == {f"--{k}": str(getattr(own, k)) for k in names}

        script, *flags = results.find_command(f"{name}_maniskill")
        args = ppo.parse_args(flags)
        assert all(getattr(args, k) == getattr(own, k) for k in names) and args.num_eval_steps is None
        assert 0.6 < args.eval_freq * args.batch_size / interval < 1.7
        assert (args.num_envs, args.cuda, args.norm_obs, args.num_minibatches) == (64, False, False, 32)


def test_rows_are_of_todays_recipes(monkeypatch):
    """The flags of each row in the table are those that its recipe and the defaults give today."""
    for module in (ppo, ppo_rgb):
        monkeypatch.setattr(module, "num_cores", lambda: 2)
    rows = results.read_rows(results.FOLDER / "results.jsonl")
    keys = [(row["recipe"], row["further_flags"], row["seed"]) for row in rows]
    assert len(set(keys)) == len(keys), "a row must not be there twice"
    commands = {recipe: results.find_command(recipe) for recipe in {row["recipe"] for row in rows}}
    of_the_run = {"seed", "exp_name", "capture_video", "num_actors", "checkpoint"}
    for row in rows:
        script, *flags = commands[row["recipe"]]
        if row["recipe"].endswith("_sb3"):
            assert row["flags"]["env_id"] == flags[1] and str(row["flags"]["total_timesteps"]) in flags
            continue
        flags += shlex.split(row["further_flags"])
        today = asdict({"ppo.py": ppo, "ppo_rgb.py": ppo_rgb}[script].parse_args(flags))
        for name in today.keys() - of_the_run:
            assert row["flags"][name] == today[name], (row["recipe"], name)
        assert (row["flags"]["checkpoint"] is not None) == (row["recipe"] in results.STARTS_FROM)
        assert row["steps"] == row["curve"][-1][0] and row["curve"][0][0] == 0
