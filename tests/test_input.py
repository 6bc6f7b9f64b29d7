"""Bad input is refused with exit code 2 and one line, and nothing is written. Good input runs."""

import os
import random
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import batched_env
import pytest
import torch
from conftest import NO_VULKAN, ROOT, refused

import ppo
import ppo_rgb


@pytest.mark.parametrize(
    "arguments, message",
    [
        ("--env_id PushCub-v1", "PushCube-v1"),
        ("--env_id no.such.module:Task-v1", "no"),
        ("--env_id PutCarrotOnPlateInScene-v1", "download_asset PutCarrotOnPlateInScene-v1"),
        ("--env_id PickSingleYCB-v1", "python -m mani_skill.utils.download_asset PickSingleYCB-v1"),
        ("--env_id AnymalC-Reach-v1", "python -m mani_skill.utils.download_asset anymal_c"),
        ("--control_mode pd_thoughts", "pd_thoughts not in supported modes: ['pd_joint_delta_pos'"),
        ("--env_id MS-CartpoleBalance-v1 --control_mode pd_ee_delta_pos", "MS-CartpoleBalance-v1: "),
        ("--robot_uids pandaa", "panda"),
        ("--reward_mode sparse --env_id MS-AntRun-v1", "Unsupported reward mode: sparse"),
        ("--obs_mode rgb", "ppo_rgb.py"),
        ("--num_envs 0", "num_envs"),
        ("--num_actors 0", "num_actors"),
        ("--num_envs 2 --num_actors 3", "--num_actors 3: there are 2 environments"),
        ("--num_eval_envs 800 --num_eval_episodes 800", "one process simulates at most 800"),
        ("--reconfiguration_freq 1 --num_envs 2 --num_actors 1", "--no-partial_reset"),
        ("--num_steps -1", "num_steps"),
        ("--learning_rate nan", "learning_rate"),
        ("--learning_rate 0", "learning_rate"),
        ("--gamma 1.01", "gamma"),
        ("--max_grad_norm inf", "max_grad_norm"),
        ("--target_kl nan", "target_kl"),
        ("--stop_at_success 95", "stop_at_success"),
        ("--num_envs 2 --num_steps 3 --num_minibatches 7", "num_minibatches"),
        ("--total_timesteps 10 --num_envs 4 --num_steps 4", "--num_envs 4 x --num_steps 4 = 16 steps"),
        ("--env_id MyTask-v1", "a task in your own file is module:MyTask-v1"),
        ("--sim_backend physx_quantum", "sim_backend"),
        ("--render_backend paper", "render_backend"),
        ("--env_kwargs [1]", "env_kwargs"),
        ("--env_kwargs {", "env_kwargs"),
        ('--env_kwargs {"colour":1}', "unexpected keyword argument 'colour' ("),
        ('--env_kwargs {"num_envs":1}', "--num_envs"),
        ('--env_kwargs {"max_episode_steps":-5}', "positive, actually: -5"),
        ('--env_kwargs {"max_episode_steps":[1]}', "integer, actually"),
        ("--env_id TwoRobotPickCube-v1 --robot_uids foo", "Agent foo not found"),
        ("--env_id .x:Y", ".x:Y"),
        ("--env_id half:Task-v1", "SyntaxError: '(' was never closed (half.py, line 1)"),
        ("--robot_uids none", "PushCube-v1: "),
        ("--env_id PickCube-v1 --robot_uids xarm6_robotiq", "download_asset xarm6_robotiq"),
        ("--evaluate", "--checkpoint"),
        ("--evaluate --checkpoint nowhere.pt", "nowhere.pt"),
        ("--evaluate --checkpoint garbage.pt", "garbage.pt"),
        ("--resume nowhere", "nowhere"),
        ("--resume runs", "runs/last.pt"),
        ("--exp-name there", "--resume runs/there"),
        ("--exp-name ../garbage.pt/x", "garbage.pt"),
        ("--exp-name " + 300 * "x", "too long"),
        ("--eval_seed 2147483647", "eval_seed"),
        ("--gama 0.9", "--gamma"),
        ("--num_envs", "num-envs"),
        ("--num_envs many", "many"),
        pytest.param("--sim_backend physx_cuda --cuda", "CUDA|NVIDIA",
                     marks=pytest.mark.skipif(torch.cuda.is_available(), reason="has one")),
    ],
)  # fmt: skip
def test_bad_input(arguments, message, in_tmp, capsys, monkeypatch):
    (in_tmp / "garbage.pt").write_bytes(b"not a checkpoint")
    (in_tmp / "runs/there").mkdir(parents=True)
    (in_tmp / "half.py").write_text("print(")
    monkeypatch.syspath_prepend(in_tmp)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (in_tmp / "runs/there/metrics.jsonl").write_text("{}\n")
    small = "--no-cuda --no-capture_video --num_envs 2 --num_actors 1 --num_eval_envs 1 --num_eval_episodes 1 "
    small += "--num_steps 50 --total_timesteps 100"
    line = refused([*small.split(), *arguments.split()], capsys)
    assert any(part in line for part in message.split("|")), line


def test_physx_without_its_library_is_refused(in_tmp, capsys, monkeypatch):
    """SAPIEN raises these errors if the unversioned libcuda.so or the download is missing. The line names a remedy."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch, "zeros", lambda *args, **kwargs: None)
    for error, remedy in (
        (OSError("libcuda.so: cannot open shared object file: No such file or directory"), "libcuda.so.1"),
        (ConnectionError("HTTPSConnectionPool: Max retries exceeded"), "check_machine.py"),
    ):

        def enable_gpu(error=error):
            raise error

        monkeypatch.setattr(ppo.sapien.physx, "enable_gpu", enable_gpu)
        assert remedy in refused(["--sim_backend", "physx_cuda", "--no-capture_video"], capsys)


@pytest.mark.parametrize("script", [ppo, ppo_rgb])
def test_one_process_at_a_time_downloads_physx(script, monkeypatch, tmp_path):
    inside, most = [], []

    def enable_gpu():
        inside.append(1)
        time.sleep(0.05)
        most.append(len(inside))
        inside.pop()

    monkeypatch.setattr(script.sapien.physx, "enable_gpu", enable_gpu)
    monkeypatch.setattr(torch, "zeros", lambda *args, **kwargs: None)
    monkeypatch.setattr(script, "parse_backends", lambda *args: None)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    args = script.Args(sim_backend="physx_cuda:0", num_actors=1)
    threads = [threading.Thread(target=script.check_simulation, args=(args,)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1] * 4


MISTAKEN = """
from mani_skill.envs.tasks import PushCubeEnv
from mani_skill.utils.registration import register_env

@register_env("Mistaken-v1", max_episode_steps=10, override=True)
class Mistaken(PushCubeEnv):
    def _initialize_episode(self, env_idx, options):
        {mistake}
"""


@pytest.mark.parametrize("mistake", ["self.cube.set_pose(self.nothing)", "None + 1"])
def test_a_mistake_in_a_task_shows_its_traceback(mistake, in_tmp, capfd, monkeypatch):
    """Also if it is a TypeError, which gym.make raises again. Nothing is written."""
    (in_tmp / "mistaken.py").write_text(MISTAKEN.format(mistake=mistake))
    monkeypatch.syspath_prepend(in_tmp)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.delitem(sys.modules, "mistaken", raising=False)
    flags = "--env_id mistaken:Mistaken-v1 --no-cuda --num_envs 2 --num_actors 1 --num_eval_envs 1"
    assert ppo.main(flags.split()) == 1
    errors = capfd.readouterr().err
    assert "Traceback" in errors and "mistaken.py" in errors and mistake in errors
    assert [path.name for path in in_tmp.iterdir()] == ["mistaken.py"]


def test_a_mistake_in_the_module_of_a_task_shows_its_traceback(in_tmp, monkeypatch):
    (in_tmp / "divided.py").write_text("1 / 0")
    monkeypatch.syspath_prepend(in_tmp)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    with pytest.raises(ZeroDivisionError):
        ppo.main(["--env_id", "divided:Task-v1", "--no-cuda"])


@pytest.mark.slow
@pytest.mark.parametrize("first", ["mani_skill.envs", "ppo_rgb"])
def test_scripts_and_maniskill_are_imported_in_any_order_without_vulkan(first, tmp_path):
    code = f"import {first}, mani_skill.envs, ppo, ppo_rgb; env = ppo.gym.make('PushCube-v1', num_envs=2, "
    code += "sim_backend='physx_cpu', render_backend='none'); print(ppo.RENDER_DEVICE, env.reset(seed=0)[0].shape)"
    environment = {**os.environ, **NO_VULKAN, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", code]
    process = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert process.stdout.startswith("None torch.Size([2, "), process.stderr


@pytest.mark.parametrize("script", [ppo, ppo_rgb])
def test_ray_tracing_of_a_batch_is_refused(script, in_tmp, capsys):
    line = refused(["--sim_backend", "physx_cuda", "--shader", "rt-fast"], capsys, script)
    assert "ray tracing needs CPU simulation" in line


def test_exact_resume_on_a_gpu_is_refused(in_tmp, capsys):
    assert "needs CPU simulation" in refused(["--sim_backend", "physx_cuda", "--exact_resume"], capsys)


def test_no_cuda_with_simulation_on_a_gpu_is_refused(in_tmp, capsys):
    """A resumed run brings its simulation along: the line says how to change that."""
    assert "give --sim_backend physx_cpu as well" in refused(["--sim_backend", "physx_cuda", "--no-cuda"], capsys)


def test_driver_too_old(in_tmp, capsys, monkeypatch):
    """With physx_cuda, the script refuses to run and prints the reason. Else it prints it, and learns on the CPU."""

    def zeros(*args, device=None, **kwargs):
        raise RuntimeError("The NVIDIA driver on your system is too old (found version 11000).\nPlease update.")

    monkeypatch.setattr(torch, "zeros", zeros)
    assert "driver on your system is too old" in refused(["--sim_backend", "physx_cuda"], capsys)

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    exists = Path.exists
    monkeypatch.setattr(Path, "exists", lambda path: path == Path("/proc/driver/nvidia") or exists(path))
    args = ppo.parse_args([])
    ppo.check_simulation(args)
    assert "the GPU is not used: The NVIDIA driver" in capsys.readouterr().out
    assert ppo.choose_device(args).type == "cpu"


@pytest.mark.parametrize(
    "arguments, note",
    [
        ("--env_id MS-CartpoleSwingUp-v1", "--gamma 0.9 looks 10 steps ahead, and an episode has 1000"),
        ("", None),
        ("--gamma 0.99 --env_id MS-CartpoleSwingUp-v1", None),
    ],
)  # fmt: skip
def test_note_on_gamma(arguments, note, capsys):
    args = ppo.parse_args(["--no-cuda", "--num_envs", "1", *arguments.split()])
    envs = ppo.make_envs(args, 1, 0)
    ppo.check_task(args, envs)
    envs.close()
    output = capsys.readouterr().out
    assert output.count("note:") == (note is not None) and (note or "") in output


VALID = {
    "num_envs": [1, 2, 7], "num_eval_envs": [1, 3], "num_actors": [1], "num_eval_episodes": [1, 4], "num_steps": [4, 9],
    "num_minibatches": [1, 3, 4], "update_epochs": [1, 2], "learning_rate": [1e-9, 0.1, 3], "seed": [0, 2**40],
    "critic_learning_rate": [0, 1e-3, None], "logstd_lr_factor": [0, 2], "desired_kl": [1e-3, 1],
    "gamma": [0, 0.97, 1], "gae_lambda": [0, 0.5, 1], "clip_coef": [0.01, 5],
    "ent_coef": [0, 0.1], "vf_coef": [0, 2], "max_grad_norm": [1e-3, 100], "target_kl": [None, 0, 0.02],
    "reward_scale": [1e-3, 10], "bootstrap_at_done": ["always", "truncated", "never"], "logstd_init": [-3, 0.5],
    "logstd_final": [None, -2],
    "eval_freq": [0, 1, 2], "num_eval_steps": [None, 1, 100], "eval_seed": [0, 2**30], "stop_at_success": [None, 0, 1],
    "save_freq": [None, 1], "checkpoint_freq": [1, 3], "exp_name": ["x", "a/b c"],
    "reward_mode": [None, "sparse", "dense"], "control_mode": [None, "pd_ee_delta_pose"], "robot_uids": [None, "panda"],
    "env_kwargs": ["{}", '{"max_episode_steps": 30}'], "render_backend": ["none", "cpu", "gpu"],
    "sim_backend": ["cpu", "physx_cpu"], "reconfiguration_freq": [None, 0, 1], "render_mode": ["all", "sensors"],
    "shader": ["minimal"], "wandb_entity": [None, "us"], "total_timesteps": [126, 500],
}  # fmt: skip
SWITCHES = [
    "anneal_lr", "norm_adv", "clip_vloss", "finite_horizon_gae", "norm_obs", "layer_norm", "save_model",
    "exact_resume", "partial_reset", "eval_partial_reset", "torch_deterministic", "cudagraphs",
]  # fmt: skip
NUMBERS = ["0", "-1", "1.5.", "nan", "inf", "x", ""]
INVALID = {
    **{flag: NUMBERS for flag in ("num_envs", "num_eval_envs", "num_actors", "num_steps", "num_minibatches",
                                  "update_epochs", "num_eval_episodes", "learning_rate", "clip_coef", "max_grad_norm",
                                  "checkpoint_freq", "reward_scale")},
    **{flag: NUMBERS[1:] for flag in ("seed", "eval_freq", "ent_coef", "vf_coef", "target_kl", "eval_seed")},
    **{flag: [*NUMBERS[1:], "1.1"] for flag in ("gamma", "gae_lambda", "stop_at_success")},
    "logstd_init": ["nan", "inf", "?"], "logstd_final": ["nan", "6"], "total_timesteps": ["0", "3", "-5", "1e5x"],
    "env_kwargs": ["", "{", "[]", '{"num_envs": 3}'],
    "env_id": ["", "PushCube", "pushcube-v1", ":", "a:b:c", "os:PushCube-v9"],
    "obs_mode": ["rgb", ""], "reward_mode": ["best"],
    "sim_backend": ["", "gazebo"], "bootstrap_at_done": ["sometimes"], "render_backend": ["gpu:", "vulkan"],
    "render_mode": ["human"], "shader": ["x"],
    "resume": ["", "nowhere", "."], "checkpoint": ["nowhere", "."], "nonsense": ["1"], "partial_reset": ["maybe"],
}  # fmt: skip


@pytest.mark.slow
def test_fuzz(in_tmp, capsys, monkeypatch):
    """Of 120 generated command lines, the valid ones run, and those with one invalid value are refused. test_bad_input
    has the errors that appear only when the task is built: these environments accept everything."""
    rng = random.Random(0)
    monkeypatch.setattr(ppo, "make_envs", partial(batched_env.make_envs, device="cpu"))
    monkeypatch.setattr(ppo, "plot_learning_curve", lambda run_dir: None)  # slow

    def spell(flag, value):
        flag = "--" + rng.choice([flag, flag.replace("_", "-")])
        return [f"{flag}={value}"] if rng.random() < 0.5 else [flag, str(value)]

    counts = [0, 0]
    for k in range(120):
        base = dict(num_envs=7, num_eval_envs=2, num_actors=1, num_eval_episodes=2, num_steps=9, total_timesteps=126,
                    num_minibatches=4, update_epochs=1, desired_kl=None, logstd_lr_factor=1,
                    exp_name=f"run{k}")  # fmt: skip
        chosen = base | {flag: rng.choice(VALID[flag]) for flag in rng.sample([*VALID], rng.randrange(12))}
        if chosen["num_envs"] * chosen["num_steps"] < chosen["num_minibatches"]:
            chosen["num_minibatches"] = 1
        chosen["exp_name"] = f"run{k}/{chosen['exp_name']}"
        switches = ["--" + rng.choice(["", "no-"]) + flag for flag in rng.sample(SWITCHES, rng.randrange(5))]
        if chosen.get("reconfiguration_freq"):  # together with partial resets it is refused
            switches = [x for x in switches if not x.endswith("-partial_reset")] + ["--no-partial_reset"]
        invalid = rng.random() < 0.5
        if invalid:
            flag = rng.choice([*INVALID])
            chosen[flag] = rng.choice(INVALID[flag])
        parts = [spell(flag, value) for flag, value in chosen.items()] + [[switch] for switch in switches]
        rng.shuffle(parts)
        arguments = ["--no-cuda", "--no-capture-video", *sum(parts, [])]
        print(arguments)
        if invalid:
            refused(arguments, capsys)
        else:
            code, errors = ppo.main(arguments), capsys.readouterr().err
            assert code == 0 or "weights that are not finite" in errors, (arguments, errors)
            assert (Path("runs") / chosen["exp_name"] / "metrics.jsonl").exists()
        counts[invalid] += 1
        capsys.readouterr()
    assert min(counts) > 42
