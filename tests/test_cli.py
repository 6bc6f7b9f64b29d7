"""The script as a command: it trains, evaluates, writes videos, and refuses bad flags."""

import contextlib
import json
import math
import os
import re
import subprocess
import sys
import weakref
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from conftest import NO_VULKAN, ROOT, Stop, crash, read_metrics, refused, run_script, same_weights, scalars

import ppo
import ppo_rgb

TINY = ("--num_envs", 1, "--num_eval_envs", 1, "--num_eval_episodes", 2, "--num_steps", 20, "--total_timesteps", 40,
        "--num_minibatches", 2, "--no-cuda", "--exp-name", "tiny")  # fmt: skip


def test_run_folder(trained):
    folder, output, errors = trained
    rows = read_metrics(folder)
    train_rows = [row for row in rows if row["kind"] == "train"]
    evaluations = [row for row in rows if row["kind"] == "eval"]
    assert [row["global_step"] for row in train_rows] == [80, 160, 240, 320, 400]
    assert [row["iteration"] for row in train_rows] == [1, 2, 3, 4, 5]
    assert [row["global_step"] for row in evaluations] == [0, 160, 320, 400]
    for row in evaluations:
        assert row["num_episodes"] == 6 and row["episode_len"] == 50
        assert 0 <= row["success_at_end"] <= row["success_once"] <= 1 and row["return"] > 0
    for row in train_rows:
        assert row["sps"] > 0 and all(math.isfinite(v) for v in row.values() if not isinstance(v, str))
    about = json.loads((folder / "args.json").read_text())
    assert about["args"]["num_envs"] == 4 and about["args"]["sim_backend"] == "physx_cpu"
    assert about["versions"].keys() >= {"mani-skill", "torch", "sapien"} and "--num-steps 20" in about["command"]
    assert (folder / "learning_curve.png").stat().st_size > 5000
    assert list(folder.glob("events.out.tfevents.*"))
    names = {"best.pt", "last.pt", "iteration_2.pt", "iteration_4.pt"}
    assert {path.name for path in folder.glob("*.pt")} == names and not (folder / "videos").exists()
    assert errors == "", "without a terminal there must be no progress bar and no warning"
    assert output.count("evaluation:") == 4 and "runs/small" in output


def test_tensorboard_holds_the_same_numbers(trained):
    folder, *_ = trained
    rows, logged = read_metrics(folder), scalars(folder)
    for kind, key in (("train", "learning_rate"), ("train", "value_loss"), ("eval", "return")):
        expected = {row["global_step"]: row[key] for row in rows if row["kind"] == kind}
        assert logged[f"{kind}/{key}"] == pytest.approx(expected)


def test_load_agent(trained):
    """As in README: a policy for another program, and environments that fit."""
    path = trained[0] / "last.pt"
    agent, args = ppo.load_agent(path)
    envs = ppo.make_envs(args, 2, 0, evaluation=True)
    obs, _ = envs.reset(seed=[0, 1])
    with torch.no_grad():
        action = agent.get_action(obs)
    envs.step(action)
    envs.close()
    assert action.shape == (2, 8) and not agent.training
    assert same_weights({"agent": agent.state_dict()}, ppo.load_checkpoint(path))


class Wandb:
    """Stands in for the package: remembers what it is given, and names the run "the-run"."""

    __spec__ = "found"

    def __init__(self):
        self.inits, self.exit_codes = [], []

    def init(self, **kwargs):
        self.inits.append(kwargs)
        return SimpleNamespace(id="the-run", finish=lambda exit_code: self.exit_codes.append(exit_code))


def test_weights_and_biases(in_tmp, monkeypatch):
    """A resumed run goes on as the same run there, and one that fails says so."""
    wandb = Wandb()
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    flags = (*TINY, "--track", "--no-capture_video", "--env_id", "MS-CartpoleBalance-v1")
    flags += ("--wandb_group", "mine", "--env_kwargs", '{"max_episode_steps": 3}')
    assert ppo.main([*map(str, flags)]) == 0
    assert ppo.main(["--resume", "runs/tiny", "--total_timesteps", "60"]) == 0
    assert ppo.main(["--resume", "runs/tiny", "--total_timesteps", "80", "--no-track"]) == 0
    monkeypatch.setattr(ppo, "rollout", crash)
    assert ppo.main(["--resume", "runs/tiny", "--total_timesteps", "100", "--track"]) == 1
    assert [init["id"] for init in wandb.inits] == [None, "the-run", "the-run"]
    assert wandb.exit_codes == [0, 0, 1]
    assert all(init["name"] == "tiny" and init["group"] == "mine" for init in wandb.inits)


def test_evaluate_needs_the_checkpoint_alone(trained, tmp_path, monkeypatch, capsys):
    folder, *_ = trained
    command = ("--evaluate", "--checkpoint", folder / "last.pt", "--no-capture_video", "--num_actors", 1, "--no-cuda")
    monkeypatch.chdir(tmp_path)
    assert ppo.main([*map(str, command), "--num_eval_episodes", "5", "--eval-seed", "100"]) == 0
    output = capsys.readouterr().out
    results = json.loads((folder / "eval.json").read_text())
    assert results["num_episodes"] == 5 and results["eval_seed"] == 100
    for key in ("success_once", "success_at_end", "return", "episode_len"):
        low, high = results[f"{key}_interval"]
        assert low <= results[key] <= high and f"{results[key]:.3f}" in output
    assert not list(tmp_path.iterdir()), "everything is written next to the checkpoint"
    # repeat the last evaluation of the training run; PhysX remembers contacts of earlier episodes, so it is not exact
    assert ppo.main([*map(str, command), "--num_eval_episodes", "6", "--num_eval_envs", "2"]) == 0
    last = json.loads((folder / "metrics.jsonl").read_text().splitlines()[-1])
    results = json.loads((folder / "eval.json").read_text())
    assert {k: results[k] for k in ("return", "success_once")} == pytest.approx(
        {k: last[k] for k in ("return", "success_once")}, rel=0.05
    )


def test_a_run_folder_stands_for_its_last_checkpoint(trained):
    """--checkpoint accepts a run folder, and the results of --evaluate go into that folder."""
    args = ppo.parse_args(["--evaluate", "--checkpoint", str(trained[0])])
    assert args.checkpoint == str(trained[0] / "last.pt") and ppo.find_run_dir(args) == trained[0]


def test_wilson_interval():
    """Rates, and other numbers that are all 0 or 1, get the score interval, to three digits (Newcombe 1998, table I:
    81/263, 15/148, 0/20, 1/29). Other means get the normal interval."""
    for successes, n, low, high in (
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ):
        values = torch.cat([torch.ones(successes), torch.zeros(n - successes)])
        assert ppo.interval(values) == pytest.approx((low, high), abs=2e-4)
    values = torch.arange(10.0)
    half = 1.96 * values.std().item() / 10**0.5
    assert ppo.interval(values) == pytest.approx((4.5 - half, 4.5 + half))


def test_commands_for_the_peers_scripts_parse(trained):
    """Flags parse as ManiSkill's ppo.py and ppo_fast.py and CleanRL's scripts spell them."""
    args = ppo.parse_args(
        "--env_id=PushCube-v1 --num_envs=2048 --update_epochs=8 --num_minibatches=32 --total_timesteps=2_000_000 "
        "--eval_freq=10 --num-steps=20 --seed 5 --gamma=0.99 --gae_lambda 0.95 --no-capture_video --save_trajectory "
        "--track --wandb_entity me --wandb_project_name P --wandb_group G --cudagraphs --compile --exp-name=x "
        "--no-torch_deterministic --no-cuda --learning_rate 1e-4 --anneal_lr --no-norm_adv --clip_coef 0.1 "
        "--clip_vloss --ent_coef 0.01 --vf_coef 1 --max_grad_norm 1 --target_kl None --reward_scale 0.5 "
        "--finite_horizon_gae --no-partial_reset --eval_partial_reset --reconfiguration_freq 1 "
        "--eval_reconfiguration_freq 1 --control_mode pd_ee_delta_pose --robot_uids panda --num_eval_envs 4 "
        "--num-eval-steps 100 --save-model --save_train_video_freq 5 --render_mode all "
        f"--checkpoint {trained[0] / 'last.pt'}".split()
    )
    assert (args.num_envs, args.num_steps, args.total_timesteps, args.target_kl) == (2048, 20, 2_000_000, None)
    assert args.anneal_lr and not args.norm_adv and not args.capture_video and args.cudagraphs and args.track
    assert args.norm_obs, "--checkpoint must bring its network along"
    assert (args.control_mode, args.batch_size, args.num_iterations) == ("pd_ee_delta_pose", 40960, 48)


@pytest.mark.parametrize(
    "cores, num_envs, num_steps",
    [(1, 128, 12), (2, 128, 12), (4, 128, 12), (8, 256, 6), (16, 512, 5), (32, 512, 5), (64, 512, 5)],
)
def test_defaults_by_cores(monkeypatch, cores, num_envs, num_steps):
    """Every core simulates. With many cores, an iteration still has few steps, so that there are enough iterations."""
    monkeypatch.setattr(ppo, "num_cores", lambda: cores)
    args = ppo.parse_args(["--no-cuda"])
    assert (args.sim_backend, args.num_actors) == ("physx_cpu", cores)
    assert (args.num_envs, args.num_eval_envs, args.num_steps) == (num_envs, num_envs, num_steps)
    assert args.num_iterations == 75 and args.batch_size <= 2560 and args.desired_kl == 0.05
    args = ppo.parse_args(["--no-cuda", "--num_envs", "512", "--num_minibatches", "3"])
    assert args.num_envs == 512 and args.num_minibatches == 3 and args.num_iterations == 75 and args.num_steps == 5
    assert ppo.parse_args(["--no-cuda", "--num_envs", "1"]).num_actors == 1
    ppo.check_simulation(ppo.parse_args(["--no-cuda", "--num_actors", "1"]))  # README's remedy for little shared memory
    assert ppo.parse_args(["--no-cuda", "--num_envs", "4096"]).num_actors == max(cores, 6), "800 in a process"
    assert ppo.parse_args(["--no-cuda", "--total_timesteps", "9999"]).total_timesteps == 9999


@pytest.mark.parametrize("cores, num_envs, num_steps", [(1, 32, 50), (2, 64, 25), (16, 64, 25), (128, 64, 25)])
def test_defaults_for_images_by_cores(monkeypatch, cores, num_envs, num_steps):
    """Pictures are rendered one after the other, so more cores have smaller shares of the same environments."""
    monkeypatch.setattr(ppo_rgb, "num_cores", lambda: cores)
    args = ppo_rgb.parse_args(["--no-cuda"])
    assert (args.num_envs, args.num_eval_envs, args.num_steps) == (num_envs, num_envs, num_steps)
    assert args.num_actors == min(cores, num_envs) and args.num_iterations == 150


@pytest.mark.parametrize("quota, expected", [("max 100000", 64), ("150000 100000", 2), ("5000 100000", 1), ("", 64)])
def test_cores_of_a_container(monkeypatch, quota, expected):
    """A container with a quota sees all cores of its host. It must not start a process on each."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: range(64))
    monkeypatch.setattr(ppo.Path, "read_text", lambda path: quota)
    assert ppo.num_cores() == expected


@pytest.mark.parametrize("num_envs, num_steps", [(512, 8), (4096, 5), (16, 256)])
def test_defaults_of_a_gpu(monkeypatch, num_envs, num_steps):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    args = ppo.parse_args(["--num_envs", str(num_envs)])
    assert (args.sim_backend, args.num_steps, args.num_actors) == ("physx_cuda:0", num_steps, 1)
    assert args.num_iterations == 75 and args.exp_name.startswith("PushCube-v1__ppo__1__")
    rest = dict(sim_backend="physx_cuda:0", num_envs=num_envs, num_steps=num_steps, num_actors=1)
    rest |= dict(total_timesteps=args.total_timesteps, exp_name=args.exp_name)
    assert args == replace(ppo.Args(), **rest) and ppo.parse_args([]).num_envs == 512


def test_defaults_by_backend(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    args = ppo.parse_args([])
    with monkeypatch.context() as patch:
        patch.setattr(ppo, "WORLD_SIZE", 2)
        patch.setattr(ppo, "LOCAL_RANK", 1)
        local = ppo.local_args(ppo.parse_args([]))
        assert local.sim_backend == "physx_cuda:1" and local.num_envs == 256, "each process has its own GPU"
    with monkeypatch.context() as patch:
        patch.setattr(ppo, "WORLD_SIZE", 3)
        assert ppo.parse_args([]).num_envs == 510, "a multiple of the number of processes"
    assert args.num_eval_envs >= args.num_eval_episodes, "an evaluation must take one round of episodes"
    args = ppo.parse_args(["--sim_backend", "physx_cuda:1", "--num_envs", "4096", "--num-steps", "4"])
    assert ppo.choose_device(args) == torch.device("cuda:1") and args.num_minibatches == 4
    args = ppo.parse_args(["--sim_backend", "physx_cpu"])
    assert ppo.choose_device(args) == torch.device("cuda:0")
    args = ppo.parse_args(["--sim_backend", "physx_cpu", "--no-cuda"])
    assert ppo.choose_device(args) == torch.device("cpu")


def test_the_gpu_that_simulates_is_torchs_current_device(monkeypatch):
    """CUDA graphs are captured on the current device."""
    devices = []
    monkeypatch.setattr(torch.cuda, "set_device", devices.append)
    device = ppo.start_processes(ppo.Args(sim_backend="physx_cuda:1", exp_name="x"), None)[2]
    assert devices == [device] == [torch.device("cuda:1")]


def test_help_shows_every_flag_with_this_machines_defaults(capsys):
    with pytest.raises(SystemExit) as error:
        ppo.parse_args(["--help"])
    output = capsys.readouterr().out
    assert error.value.code == 0
    for field in ppo.Args.__dataclass_fields__:
        assert "--" + field.replace("_", "-") in output or "--" + field in output
    assert f"{ppo.parse_args([]).num_envs}" in output


def test_flags_are_spelled_with_hyphens_or_underscores():
    for no, yes in (("--no_capture_video", "--anneal_lr"), ("--no-capture-video", "--anneal-lr")):
        args = ppo.parse_args(["--no-cuda", no, yes])
        assert not args.capture_video and args.anneal_lr
    for flag in ("--no_capture-video", "--no-capture_video"):
        assert not ppo.parse_args(["--no-cuda", flag]).capture_video


def test_help_may_be_cut_off(tmp_path):
    command = f"{sys.executable} {ROOT / 'ppo.py'} --help | head -n 3"
    process = subprocess.run(command, shell=True, cwd=tmp_path, capture_output=True, text=True)
    assert process.stdout.count("\n") == 3 and process.stderr == ""


@pytest.mark.slow
def test_other_kinds_of_task(tmp_path):
    """Tasks with Dict action spaces, without success, with other robots or with sparse reward train without Vulkan."""
    env_ids = ("TwoRobotPickCube-v1", "MS-HopperHop-v1", "DrawTriangle-v1", "PullCubeTool-v1")
    flags = [*map(str, TINY), "--num_envs", "2", "--num_actors", "1", "--env_kwargs", '{"max_episode_steps": 10}']
    (tmp_path / "all.py").write_text(f"""
import sys
sys.path.insert(0, {str(ROOT)!r})
import ppo
if __name__ == "__main__":
    assert not any(ppo.main([*{flags!r}, "--env_id", x, "--exp_name", x]) for x in {env_ids!r})
""")
    process = run_script(cwd=tmp_path, env=NO_VULKAN, script=tmp_path / "all.py")
    assert process.returncode == 0, process.stderr
    for env_id in env_ids:
        rows = read_metrics(tmp_path / "runs" / env_id)
        assert rows[-1]["kind"] == "eval" and rows[-1]["episode_len"] == 10
        assert ("success_once" in rows[-1]) == (env_id != "MS-HopperHop-v1")


@pytest.mark.slow
def test_terminal_without_vulkan_shows_one_bar_and_lines_that_stay(tmp_path):
    """One of the lines says why there is no video, and how to get a renderer. The last one repeats `uv run`."""
    uv_run = {"UV_RUN_RECURSION_DEPTH": "1"}
    import fcntl
    import pty
    import struct
    import termios

    main_end, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 120, 0, 0))
    command = [
        sys.executable,
        str(ROOT / "ppo.py"),
        *map(str, TINY),
        *"--num_steps 100 --total_timesteps 200 --eval_freq 1".split(),
    ]
    process = subprocess.Popen(
        command,
        cwd=tmp_path,
        env={**os.environ, **NO_VULKAN, **uv_run},
        stdin=terminal,
        stdout=terminal,
        stderr=terminal,
    )
    os.close(terminal)
    output = b""
    while True:
        try:
            output += os.read(main_end, 65536)
        except OSError:  # the other end is closed
            break
    assert process.wait() == 0
    assert output.count(b"no videos: there is no Vulkan") == 1 and b"mesa-vulkan-drivers" in output
    assert (tmp_path / "runs/tiny/best.pt").exists() and not (tmp_path / "runs/tiny/videos").exists()
    text = re.sub(r"\x1b\[[0-9;]*[A-Za-z]", "", output.decode()).replace("\r\n", "\n")
    # what stays on a line is what came after the last carriage return
    staying = [line.rpartition("\r")[2] for line in text.split("\n") if line.rpartition("\r")[2].strip()]
    kinds = ["PushCube-v1: ", "writing to", "step", "no videos", "100%", "learning curve", "    uv run "]
    assert all(any(kind in line for line in staying) for kind in kinds), "\n".join(staying)
    assert sum("%|" in line for line in staying) == 1 and len(staying) == 3 + 3 + 3, "\n".join(staying)
    bars = [piece for piece in text.replace("\n", "\r").split("\r") if "steps/s" in piece]
    assert bars and all("return" in piece and "<" in piece for piece in bars), "time left, rate and return"


@pytest.mark.slow
def test_weights_do_not_depend_on_evaluation_with_real_tasks(in_tmp):
    """Evaluation does not change the weights, although it shares two processes with training."""
    for freq in (1, 0):
        flags = (*TINY, "--num_envs", 4, "--num_actors", 2, "--total_timesteps", 160, "--exp-name", freq,
                 "--eval_freq", freq, "--env_kwargs", '{"max_episode_steps": 15}')  # fmt: skip
        assert ppo.main([*map(str, flags), "--no-capture_video"]) == 0
    a, b = [ppo.load_checkpoint(f"runs/{freq}/last.pt") for freq in (1, 0)]
    assert same_weights(a, b)


CANNOT_RESET_SOME = """
import torch
from mani_skill.envs.tasks import PushCubeEnv
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Pose

@register_env("Whole-v1", max_episode_steps=10)
class Whole(PushCubeEnv):
    def _initialize_episode(self, env_idx, options):
        super()._initialize_episode(env_idx, options)
        self.obj.set_pose(Pose.create_from_pq(torch.rand(self.num_envs, 3)))
"""


def test_task_that_cannot_reset_some_environments(in_tmp, monkeypatch, capsys):
    """The task is refused in one line, and both remedies that the line names work."""
    (in_tmp / "whole.py").write_text(CANNOT_RESET_SOME)
    monkeypatch.syspath_prepend(in_tmp)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    flags = (*TINY, "--num_envs", 2, "--num_eval_envs", 2, "--env_id", "whole:Whole-v1", "--no-capture_video")
    line = refused((*flags, "--num_actors", 1), capsys)
    words = ("Whole-v1 cannot reset some", "--num_actors N --num_envs N", "--no-partial_reset")
    assert all(word in line for word in words)
    assert re.search(r"\(\w+Error: .* \(.*py, line \d+\)\)", line), "the reason, and where"
    for n, remedy in enumerate((("--num_actors", 2), ("--num_actors", 1, "--no-partial_reset"))):
        assert ppo.main([*map(str, (*flags, *remedy, "--exp-name", n))]) == 0
        assert [row["num_episodes"] for row in read_metrics(in_tmp / f"runs/{n}")] == [2, 4, 2]


def frames(path):
    import imageio.v3 as iio

    return iio.imread(path)


@pytest.mark.render
def test_videos_and_trajectories(in_tmp, capfd):
    short = '{"max_episode_steps": 8, "human_render_camera_configs": {"width": 128, "height": 128}}'
    flags = (*TINY, "--env_kwargs", short, "--save_trajectory", "--save_train_video_freq", 1, "--num_envs", 2,
             "--num_actors", 2, "--num_steps", 10, "--num_eval_envs", 4, "--num_eval_episodes", 4)  # fmt: skip
    assert ppo.main([*map(str, flags)]) == 0 and capfd.readouterr().err == ""
    run = in_tmp / "runs/tiny"
    videos = sorted(path.name for path in (run / "videos").glob("*.mp4"))
    assert videos == ["step_000000000.mp4", "step_000000040.mp4"]
    assert sorted(path.name for path in (run / "train_videos").iterdir()) == [
        "step_000000020.mp4", "step_000000040.mp4"
    ]  # fmt: skip
    images = frames(run / "videos" / videos[0])
    assert 8 <= len(images) <= 10 and images.std() > 10, "the frames must not be of one colour"
    # each actor writes one file with its part of the episodes; ManiSkill's own tool can replay them
    files = sorted(path.name for path in (run / "videos").iterdir() if path.suffix != ".mp4")
    assert files == [f"trajectory_{i}.{suffix}" for i in range(2) for suffix in ("h5", "json")]
    episodes = json.loads((run / "videos/trajectory_1.json").read_text())["episodes"]
    assert all(e["elapsed_steps"] == 8 for e in episodes)
    seeds = [e["episode_seed"] for e in episodes]
    assert seeds[:6] == [2, 3, 6, 7, 2, 3] and seeds[6:] in ([], [6, 7]), "a second look at what may be the best"
    from mani_skill.trajectory import replay_trajectory

    flags = ("--traj-path", run / "videos/trajectory_1.h5", "--sim-backend", "physx_cpu", "--allow-failure",
             "--save-traj", "--count", 1)  # fmt: skip
    replay_trajectory.main(replay_trajectory.parse_args([*map(str, flags)]))
    assert list((run / "videos").glob("trajectory_1.state*.h5")), "the replayed trajectory"

    # --evaluate films the first four episodes
    flags = ("--evaluate", "--checkpoint", run / "last.pt", "--num_actors", 1, "--num_eval_envs", 1, "--no-cuda",
             "--num_eval_episodes", 1, "--eval_seed", 7)  # fmt: skip
    assert ppo.main([*map(str, flags)]) == 0
    videos = [run / f"test_videos/seed_{seed}.mp4" for seed in range(7, 11)]
    assert sorted((run / "test_videos").iterdir()) == sorted(videos)
    assert all(8 <= len(frames(video)) <= 10 for video in videos)
    assert "test_videos" in capfd.readouterr().out


def cartpole_agent(args):
    envs = ppo.make_envs(args, 1, 0)
    envs.close()
    return ppo.Agent(envs.single_observation_space, envs.single_action_space, args)


@pytest.mark.render
def test_a_film_holds_no_more_than_two_frames(tmp_path, monkeypatch):
    """At most two frames are in memory at a time: a thousand would take a gigabyte."""
    frames = []

    class Writer(contextlib.ExitStack):
        def append_data(self, frame):
            frames.append(weakref.ref(frame))
            assert sum(ref() is not None for ref in frames) <= 2 and frame.shape == (512, 512, 3)

    monkeypatch.setattr(ppo.imageio, "get_writer", lambda path, fps: Writer())
    args = ppo.Args(env_id="MS-CartpoleBalance-v1", sim_backend="physx_cpu", env_kwargs='{"max_episode_steps": 12}')
    with contextlib.ExitStack() as closing:
        ppo.Film(args, tmp_path, closing).record(cartpole_agent(args), "long", 0)
    assert len(frames) == 13


@pytest.mark.parametrize("sim_backend, expected", [("physx_cuda:1", "gpu:1"), ("physx_cpu", "gpu")])
def test_films_have_a_renderer_before_any_other_environment(tmp_path, monkeypatch, sim_backend, expected):
    """SAPIEN renders on one device, that of the first render object of a process. The first is a renderer on the GPU
    that simulates, not a material of a training environment on whatever device Vulkan lists first."""
    made = []

    def parse(sim_backend, render_backend):
        return SimpleNamespace(render_device=SimpleNamespace(can_render=lambda: True, name=render_backend))

    def build(*args):
        made.append("environments")
        crash()

    monkeypatch.setattr(ppo, "find_render_error", lambda args: None)
    monkeypatch.setattr(ppo, "parse_backends", parse)
    monkeypatch.setattr(ppo.sapien.render, "RenderSystem", lambda device: made.append(device.name))
    monkeypatch.setattr(ppo, "Actors", build)
    args = ppo.Args(sim_backend=sim_backend, cuda=False, exp_name=str(tmp_path / "x"))
    monkeypatch.setattr(ppo, "choose_device", lambda args: torch.device("cpu"))
    for run in (ppo.train, ppo.evaluate_checkpoint):
        with contextlib.ExitStack() as closing, pytest.raises(Stop):
            run(args, closing)
    assert made == [expected, "environments"] * 2
    with contextlib.ExitStack() as closing:
        ppo.Film(replace(args, capture_video=False), tmp_path, closing)
        ppo.Film(replace(args, render_backend="none"), tmp_path, closing)
    assert len(made) == 4, "a run without films needs no renderer"


@pytest.mark.render
@pytest.mark.parametrize("broken", ["make_envs", "tile_images"])
def test_a_video_that_cannot_be_made_does_not_end_the_run(in_tmp, capsys, monkeypatch, broken):
    """Whether its environments cannot be built or its pictures cannot be written: one line, no videos, no pieces of
    one, and the run goes on."""
    function = getattr(ppo, broken)

    def failing(*args, **kwargs):
        if broken == "tile_images" or kwargs.get("film"):
            raise RuntimeError("cannot be done")
        return function(*args, **kwargs)

    monkeypatch.setattr(ppo, broken, failing)
    flags = (*TINY, "--env_id", "MS-CartpoleBalance-v1", "--env_kwargs", '{"max_episode_steps": 3}', "--eval_freq", 1)
    assert ppo.main([*map(str, flags)]) == 0
    assert capsys.readouterr().out.count("no videos: RuntimeError: cannot be done (test_cli.py, line") == 1
    assert not list(in_tmp.rglob("*.mp4"))
    assert [row["kind"] for row in read_metrics(in_tmp / "runs/tiny")] == ["eval", "train", "eval", "train", "eval"]


@pytest.mark.slow
def test_learns_a_task_of_maniskill(tmp_path):
    """The command learns a task that is cheap to simulate, with most flags at their defaults."""
    flags = ("--env_id", "MS-CartpoleBalance-v1", "--gamma", 0.99, "--gae_lambda", 0.95, "--total_timesteps", 32_000,
             "--eval_freq", 0, "--num_envs", 128, "--num_actors", 2, "--num_eval_envs", 2, "--num_eval_episodes", 2,
             "--exp-name", "x", "--no-cuda")  # fmt: skip
    process = run_script(*flags, cwd=tmp_path, env=NO_VULKAN)
    assert process.returncode == 0, process.stderr
    first, last = [row["return"] for row in read_metrics(tmp_path / "runs/x") if row["kind"] == "eval"]
    assert first < 150 and last > 500, "the highest return is 1,000"
