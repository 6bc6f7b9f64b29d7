"""Whether the commits that measured the rows of results.jsonl train and evaluate as this one does: with the same flags
and seed, both must end with the same weights and the same evaluations, bit for bit.

    python tests/benchmarks/versions.py
    python tests/benchmarks/versions.py --recipes push_cube_cpu --iterations 78          # the whole run

The runs are short ones from scratch, also those of recipes that start from a checkpoint. Rows of Stable-Baselines3 are
left out.
"""

import argparse
import shlex
import shutil
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch
from results import FOLDER, ROOT, find_command, find_recipes, group, read_rows, run_script


def train(project: Path, row: dict, num_iterations: int) -> tuple[dict[str, torch.Tensor], list]:
    """Train shortly with the flags of a row, by the script in this folder. Returns the weights, and the metrics of each
    evaluation."""
    flags, name = row["flags"], f"versions_{row['recipe']}"
    total = num_iterations * flags["num_envs"] * flags["num_steps"]
    command = ["python", *find_command(row["recipe"]), *shlex.split(row["further_flags"])]
    command += ["--seed", str(flags["seed"]), "--num_actors", str(flags["num_actors"]), "--no-capture_video"]
    command += ["--total_timesteps", str(total), "--num_eval_episodes", "8", "--exp_name", name]
    run_dir = project / "runs" / name
    shutil.rmtree(run_dir, ignore_errors=True)
    run_script(*command, project=project)
    evaluations = [
        [row.get(k) for k in ("return", "success_once", "success_at_end", "episode_len")]
        for row in read_rows(run_dir / "metrics.jsonl")
        if row["kind"] == "eval"
    ]
    return torch.load(run_dir / "last.pt", map_location="cpu")["agent"], evaluations


def is_same(run: tuple, other: tuple) -> bool:
    (agent, evaluations), (other_agent, other_evaluations) = run, other
    if agent.keys() != other_agent.keys() or evaluations != other_evaluations:
        return False
    return all(torch.equal(agent[k], other_agent[k]) for k in agent)


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    recipes = [recipe for recipe in find_recipes() if not recipe.endswith("_sb3")]
    parser.add_argument("--recipes", nargs="+", choices=recipes, default=recipes)
    parser.add_argument("--iterations", type=int, default=10)
    options = parser.parse_args(argv)
    groups = group(row for row in read_rows(FOLDER / "results.jsonl") if row["recipe"] in options.recipes)
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(2) as executor:
        for name, rows in groups.items():
            projects = [Path(folder) / commit for commit in sorted({row["commit"] for row in rows})]
            for project in projects:
                if not project.exists():
                    run_script("git", "clone", "-q", str(ROOT), str(project))
                    run_script("git", "checkout", "-q", project.name, project=project)
            now, *then = executor.map(lambda x: train(x, rows[0], options.iterations), [ROOT, *projects])
            for project, run in zip(projects, then):
                print(f"{project.name}  {'the same' if is_same(run, now) else 'DIFFERENT'}  {name}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
