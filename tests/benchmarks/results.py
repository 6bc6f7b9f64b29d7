"""What PPO reaches on ManiSkill's tasks: trains each CPU recipe of examples/recipes.sh with several seeds, evaluates
best.pt and last.pt on 256 other episodes, and appends a row a run to results.jsonl.

    python tests/benchmarks/results.py                                    # all that is missing; takes days
    python tests/benchmarks/results.py --recipes push_cube_cpu --seeds 7 8
    python tests/benchmarks/results.py --at_once 2        # shorter in all; each run's own minutes are upper bounds then
    python tests/benchmarks/results.py --recipes push_cube_cpu --flags="--no-partial_reset"     # rows of their own
    uv run --group benchmark tests/benchmarks/results.py --recipes push_cube_sb3                # Stable-Baselines3
    python tests/benchmarks/results.py --table              # writes the table in README.md here, and results.png

Stop it at any time: it skips the rows that are there, and resumes a run that was interrupted. To repeat one row:
`bash examples/recipes.sh <recipe> --seed <seed> <flags>`, then `--evaluate` with the flags of `EVALUATION`. To repeat
the row of a peer: this script with `--recipes <peer> --seeds <seed>` and another `--out`.
"""

import argparse
import json
import math
import os
import platform
import re
import shlex
import statistics
import subprocess
import sys
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import torch
from matplotlib.figure import Figure
from tqdm import tqdm

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
import ppo

FOLDER = Path(__file__).resolve().parent
EVALUATION = ("--evaluate", "--eval_seed", "100000", "--num_eval_episodes", "256", "--no-cuda", "--no-capture_video")
# Recipes that are compared with peers: ManiSkill's own flags, and Stable-Baselines3.
COMPARED = ("push_cube", "pick_cube", "cartpole_balance", "cartpole_swing_up", "ant_walk")
# Recipes that start from the last policy of another one with these flags, of the same seed.
STARTS_FROM = {
    "pull_cube_tool_cpu": ("pull_cube_tool_cpu", ["--gamma", "0.9", "--total_timesteps", "400000"]),
    "hopper_hop_cpu": ("hopper_stand_cpu", ["--no-anneal_lr", "--total_timesteps", "1500000"]),
    "ant_run_cpu": ("ant_walk_cpu", []),
}
TABLE_STARTS, TABLE_ENDS = "<!-- written by results.py -->", "<!-- end -->"


def find_recipes() -> list[str]:
    """The recipes, each followed by the runs to compare it with."""
    recipes = []
    for name in re.findall(r"^(\w+)_cpu\(\)", (ROOT / "examples/recipes.sh").read_text(), re.MULTILINE):
        recipes.append(f"{name}_cpu")
        if name in COMPARED:
            recipes += [f"{name}_maniskill", f"{name}_sb3"]
    return recipes


def find_own_recipe(recipe: str) -> str:
    """The recipe that a run is compared with: itself, if it is no peer's."""
    return re.sub("_(maniskill|sb3)$", "_cpu", recipe)


def find_flags(recipe: str, *flags: str) -> list[str]:
    """The script that a recipe runs, and its flags."""
    stand_in = """python() { printf '%s\\0' "$@"; }; export -f python; bash "$@" """
    command = ["bash", "-c", stand_in, "bash", str(ROOT / "examples/recipes.sh"), recipe, *flags]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.split("\0")[:-1]


def find_command(recipe: str) -> list[str]:
    """The script and its flags, without seed and name. Peers have the task, the steps and the evaluations of the recipe
    that they are compared with."""
    own_recipe = find_own_recipe(recipe)
    own = find_flags(own_recipe)
    if recipe == own_recipe:
        return own
    args = ppo.parse_args(own[1:])
    interval = args.eval_freq * args.batch_size
    shared = ["--total_timesteps", str(args.total_timesteps), "--num_eval_episodes", str(args.num_eval_episodes)]
    if recipe.endswith("_sb3"):
        return ["tests/benchmarks/sb3.py", "--env_id", args.env_id, "--eval_interval", str(interval), *shared]
    shared += ["--num_eval_steps", "None"]
    # 64 environments: with ManiSkill's 1,024 or more, there would be a few updates in all
    published = find_flags(recipe.replace("_maniskill", "_gpu"), "--no-cuda", "--num_envs", "64", *shared)
    eval_freq = round(interval / ppo.parse_args(published[1:]).batch_size)
    return [*published, "--eval_freq", str(max(1, eval_freq))]


def read_rows(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def find_commit() -> str:
    def git(*arguments):
        return subprocess.run(["git", *arguments], cwd=FOLDER, check=True, capture_output=True, text=True).stdout

    changes = git("status", "--porcelain", "--", ":/ppo.py", ":/ppo_rgb.py", ":/examples")
    return git("rev-parse", "--short", "HEAD").strip() + ("-dirty" if changes else "")


def describe_processor() -> str:
    """The model of the processor, where Linux says it."""
    try:
        cpuinfo = Path("/proc/cpuinfo").read_text()
    except OSError:
        cpuinfo = ""
    names = re.findall(r"model name\s*: (.*)", cpuinfo)
    return names[0] if names else platform.machine()


def run_script(*command: str, project: Path = ROOT) -> str:
    """Returns what it printed. The recipes call `python`: let that be this interpreter."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(command, cwd=project, env={**os.environ, "PATH": path}, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{shlex.join(command)} ended with {done.returncode}:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}")
    return done.stdout


def train(command: list[str], recipe: str, seed: int, flags: list[str], num_at_once: int) -> Path:
    """The folder of the finished run. Runs at once share the cores: with processes for all of them, they would wait for
    each other."""
    name = "_".join(["results", recipe, str(seed), *(flag.strip("-") for flag in flags)])
    run_dir = ROOT / "runs" / name
    script, *own = command
    own += ["--seed", str(seed), "--exp_name", name]
    if not recipe.endswith("_sb3"):
        own.append("--no-capture_video")
        if num_at_once > 1:
            own += ["--num_actors", str(max(1, ppo.num_cores() // num_at_once))]
    if (run_dir / "last.pt").exists():
        run_script("python", script, "--resume", str(run_dir))
    elif not (run_dir / "best.json").exists():  # of sb3.py, which cannot resume
        run_script("python", script, *own, *flags)
    return run_dir


def evaluate(run_dir: Path, script: str, checkpoint: str) -> dict:
    """The metrics of 256 episodes: mean, and ends of the 95% interval."""
    path = run_dir / f"{Path(checkpoint).stem}.json"  # of sb3.py, which evaluates its policies itself
    if script.startswith("ppo"):
        run_script("python", script, "--checkpoint", str(run_dir / checkpoint), *EVALUATION)
        path = run_dir / "eval.json"
    found = json.loads(path.read_text())
    names = [k for k in ("success_once", "success_at_end", "return", "episode_len") if k in found]
    return {k: [round(x, 4) for x in (found[k], *found.get(f"{k}_interval", ()))] for k in names}


def measure_physics(run_dir: Path, num_at_once: int) -> int:
    """Steps per second of physics alone, now, in as many processes as the run had."""
    num_processes = max(1, ppo.num_cores() // num_at_once)
    command = ("python", str(FOLDER / "rollout.py"), "--physics_alone", str(num_processes))
    return int(run_script(*command, "--checkpoint", str(run_dir / "best.pt")))


def has_same_weights(run_dir: Path) -> bool:
    """Whether the last policy is the best one."""
    best, last = (torch.load(run_dir / name, map_location="cpu")["agent"] for name in ("best.pt", "last.pt"))
    return all(torch.equal(best[name], last[name]) for name in best)


def learning_curve(run_dir: Path, metric: str) -> list[tuple[int, float, float]]:
    """Of each evaluation: environment steps, seconds of training (rollout and update), and the metric."""
    seconds, points = 0.0, []
    for row in read_rows(run_dir / "metrics.jsonl"):
        if row["kind"] == "train":
            seconds += row["rollout_time"] + row["update_time"]
        else:
            points.append((row["global_step"], round(seconds, 1), round(row[metric], 4)))
    return points


def main_metric(metrics: dict) -> str:
    """The success rate, or the return if the task knows no success."""
    return "success_once" if "success_once" in metrics else "return"


def make_row(recipe: str, seed: int, flags: list[str], num_at_once: int) -> dict:
    command = find_command(recipe)
    script = command[0]
    commit = find_commit()  # the one that trains; there may be another when the row is written
    if recipe in STARTS_FROM:
        first, first_flags = STARTS_FROM[recipe]
        first_run = train(find_command(first), first, seed, first_flags, num_at_once)
        command += ["--checkpoint", str(first_run.relative_to(ROOT) / "last.pt")]
    run_dir = train(command, recipe, seed, flags, num_at_once)
    about = json.loads((run_dir / "args.json").read_text())
    best = evaluate(run_dir, script, "best.pt")
    is_same = (run_dir / "last.pt").exists() and has_same_weights(run_dir)
    last = best if is_same else evaluate(run_dir, script, "last.pt")
    curve = learning_curve(run_dir, main_metric(best))
    if "success_at_end" in best:
        curve = [(*point, at_end) for point, (_, _, at_end) in zip(curve, learning_curve(run_dir, "success_at_end"))]
    highest = max(point[2] for point in curve)
    steps, seconds, *_ = next(point for point in curve if point[2] >= 0.9 * highest)
    return dict(
        recipe=recipe,
        task=about["args"]["env_id"],
        further_flags=shlex.join(flags),
        seed=seed,
        flags=about["args"] | dict(resume=None),  # else a path of this machine, if the run was interrupted
        commit=commit,
        hardware=f"{about['device']}, {describe_processor()}",
        runs_at_once=num_at_once,
        versions=about["versions"],
        steps=curve[-1][0],
        training_seconds=curve[-1][1],
        # with images, physics is a small part
        physics_alone=measure_physics(run_dir, num_at_once) if script == "ppo.py" else None,
        best=best,
        last=last,
        steps_to_nine_tenths_of_the_best=steps,
        seconds_to_nine_tenths_of_the_best=seconds,
        curve=curve,
    )


def add_row(path: Path, *run) -> None:
    line = json.dumps(make_row(*run)) + "\n"
    with open(path, "a") as file:
        file.write(line)


def group(rows: list[dict]) -> dict[str, list[dict]]:
    """The runs of each recipe, by seed; recipes in the order of examples/recipes.sh."""
    recipes, groups = find_recipes(), defaultdict(list)
    for row in sorted(rows, key=lambda row: (recipes.index(row["recipe"]), row["further_flags"], row["seed"])):
        groups[f"{row['recipe']} {row['further_flags']}".strip()].append(row)
    return groups


def is_solved(row: dict, metric: str) -> bool:
    """Nine of ten episodes succeed; without success, the return is 0.8 of its maximum: 1 at every step."""
    best = row["best"]
    if metric in best:
        return best[metric][0] >= 0.9
    return best["return"][0] >= 0.8 * best["episode_len"][0]


def has_learned(row: dict) -> bool:
    """The success rate rose by 0.2 (less may be chance) or, without success, the return by 0.2 of its maximum."""
    values = [point[2] for point in row["curve"]]
    maximum = 1 if "success_once" in row["best"] else row["best"]["episode_len"][0]
    return max(values) - values[0] >= 0.2 * maximum


def join_seeds(runs: list[dict], policy: str, metric: str) -> str:
    """The means of the runs' evaluations, in the order of the seeds; nothing if the task does not have the metric."""
    means = [run[policy][metric][0] for run in runs if metric in run[policy]]
    digits = 0 if means and means[0] >= 100 else 2
    return ", ".join(f"{mean:,.{digits}f}" for mean in means)


def write_table(rows: list[dict], path: Path) -> None:
    """Replace the table in this file. What every seed solves is bold."""
    names = ("recipe", "task", "steps", "seeds", "success once", "success at end", "return", "last policy", "90% after")
    table = [(*names, "steps/s", "of physics alone"), ["---"] * 11]
    solved = {"success_once": set(), "success_at_end": set()}
    for name, runs in group(rows).items():
        task, means = runs[0]["task"].rpartition(":")[2], {}
        for metric in ("success_once", "success_at_end", "return"):
            means[metric] = join_seeds(runs, "best", metric)
        for metric, tasks in solved.items():
            if len(runs) >= 3 and all(is_solved(run, metric) for run in runs):
                shown = metric if metric in runs[0]["best"] else "return"
                means[shown] = f"**{means[shown].strip('*')}**"
                if find_own_recipe(runs[0]["recipe"]) == runs[0]["recipe"]:
                    tasks.add(task)
        steps_to_nine_tenths = [run["steps_to_nine_tenths_of_the_best"] for run in runs]
        all_learned = all(has_learned(run) for run in runs)
        speeds = [run["steps"] / run["training_seconds"] for run in runs]
        ratios = [x / run["physics_alone"] for x, run in zip(speeds, runs) if run.get("physics_alone")]
        line = [
            f"`{name}`",
            task,
            f"{max(run['steps'] for run in runs):,}",
            ", ".join(str(run["seed"]) for run in runs),
            *means.values(),
            join_seeds(runs, "last", main_metric(runs[0]["last"])),
            f"{statistics.median(steps_to_nine_tenths):,.0f}" if all_learned else "",
            f"{statistics.median(speeds):,.0f}",
            f"{statistics.median(ratios):.2f}" if ratios else "",
        ]
        table.append(line)
    lines = [f"| {' | '.join(line)} |" for line in table]
    text = path.read_text()
    before, after = text.partition(TABLE_STARTS)[0], text.partition(TABLE_ENDS)[2]
    path.write_text("\n".join([before + TABLE_STARTS, "", *lines, "", TABLE_ENDS]) + after)
    once, at_end = (len(tasks) for tasks in solved.values())
    num_tasks = len({row["task"] for row in rows})
    print(f"{path}: {num_tasks} tasks; every seed solves {once} at some step, and {at_end} at the end")


def draw_curves(rows: list[dict], path: Path) -> None:
    """A picture a recipe that learns, of its rows with the fewest further flags: the mean of the seeds and their range,
    of success at some step and at the end, or of the return. Peers are grey."""
    groups, peers = {}, defaultdict(list)
    for runs in group(rows).values():
        recipe = runs[0]["recipe"]
        if find_own_recipe(recipe) != recipe:
            peers[find_own_recipe(recipe)].append(runs)
        elif any(map(has_learned, runs)):
            groups[recipe] = min(groups.get(recipe, runs), runs, key=lambda runs: len(runs[0]["further_flags"]))
    if not groups:
        return
    columns = min(5, len(groups))
    lines = math.ceil(len(groups) / columns)
    figure = Figure(figsize=(2.6 * columns, 2.1 * lines), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False).flatten()
    for axis in axes[len(groups) :]:
        axis.axis("off")
    for axis, (recipe, runs) in zip(axes, groups.items()):
        for peer in peers[recipe]:
            is_sb3 = peer[0]["recipe"].endswith("_sb3")
            draw_mean(axis, peer, 2, color="grey", linestyle="--" if is_sb3 else "-")
        draw_mean(axis, runs, 2, color="C0")
        if all(len(point) > 3 for run in runs for point in run["curve"]):
            draw_mean(axis, runs, 3, color="C1")
        axis.set_title(recipe.removesuffix("_cpu"), fontsize=8)
        axis.tick_params(labelsize=7)
        is_rate = "success_once" in runs[0]["best"]
        axis.set_ylim(0, 1.03 if is_rate else None)
        axis.set_ylabel("success rate" if is_rate else "return", fontsize=7)
        axis.grid(alpha=0.3)
    figure.supxlabel("thousand environment steps", fontsize=8)
    figure.savefig(path, dpi=100)


def draw_mean(axis, runs: list[dict], column: int, **style) -> None:
    """The mean of one column of the runs' curves, and their range, where all of them were evaluated."""
    points = defaultdict(list)
    for run in runs:
        for point in run["curve"]:
            points[point[0] / 1000].append(point[column])
    x = [steps for steps, values in points.items() if len(values) == len(runs)]
    values = [points[steps] for steps in x]
    axis.fill_between(
        x, [min(v) for v in values], [max(v) for v in values], alpha=0.2, color=style["color"], linewidth=0
    )
    axis.plot(x, [statistics.mean(v) for v in values], **style)


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recipes", nargs="+", choices=find_recipes(), default=find_recipes())
    parser.add_argument("--seeds", nargs="+", type=int, default=[4, 5, 6], help="flags are chosen with 1 to 3")
    parser.add_argument("--flags", type=shlex.split, default=[], help='further flags, as --flags="--a --b"')
    parser.add_argument("--at_once", type=int, default=1, help="runs that share this machine's cores")
    parser.add_argument("--out", type=Path, default=FOLDER / "results.jsonl")
    parser.add_argument("--table", action="store_true", help="run nothing: write the table and the picture")
    options = parser.parse_args(argv)
    rows = read_rows(options.out)
    if options.table:
        write_table(rows, options.out.with_name("README.md"))
        draw_curves(rows, options.out.with_suffix(".png"))
        return
    if options.at_once > 1:  # else threads that wait for each other take time from the other run
        os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
    further_flags = shlex.join(options.flags)
    done = {(row["recipe"], row["seed"]) for row in rows if row["further_flags"] == further_flags}
    wanted = [(recipe, seed) for seed in options.seeds for recipe in options.recipes]
    missing = [run for run in wanted if run not in done]
    executor = ThreadPoolExecutor(options.at_once)
    try:
        futures = [executor.submit(add_row, options.out, *run, options.flags, options.at_once) for run in missing]
        for future in tqdm(as_completed(futures), total=len(missing), unit="run"):
            future.result()
    finally:
        executor.shutdown(cancel_futures=True)


if __name__ == "__main__":
    main(sys.argv[1:])
