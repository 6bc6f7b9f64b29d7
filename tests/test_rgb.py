"""ppo_rgb.py: its observations, their memory, and training from images. Tests of ppo.py cover the code in common."""

import json
import subprocess
import sys
from dataclasses import replace

import batched_env
import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import (
    NO_VULKAN,
    ROOT,
    Stop,
    crash,
    on_cpu_and_cuda,
    read_metrics,
    refused,
    run_script,
    same_run,
    same_weights,
)

import ppo_rgb

ARGS = ppo_rgb.Args(
    sim_backend="physx_cpu", capture_video=False, shader="minimal", num_envs=2, num_eval_envs=1, num_actors=1
)
SMALL_IMAGES = ppo_rgb.Args(
    sim_backend="physx_cpu", num_envs=16, num_eval_envs=8, num_eval_episodes=8, num_steps=10,
    total_timesteps=16 * 10 * 4, num_minibatches=4, eval_freq=2, capture_video=False, cuda=False, norm_obs=True,
    num_actors=1,
)  # fmt: skip
ALL_TEXTURES = "rgb+depth+segmentation+position+normal+albedo"


@pytest.fixture
def script():
    return ppo_rgb


@pytest.fixture
def small():
    return SMALL_IMAGES


# ----- observations ---------------------------------------------------------------------------------------------------


@pytest.mark.render
@pytest.mark.parametrize(
    "env_id, obs_mode, flags",
    [
        ("MS-CartpoleBalance-v1", "rgb+segmentation", dict(frame_stack=3, camera_width=48, camera_height=40)),
        ("MS-CartpoleBalance-v1", ALL_TEXTURES, dict(shader="default", include_state=False)),
        ("PushCube-v1", "rgb+depth", dict(robot_uids="panda_wristcam", camera_width=40, camera_height=40)),
    ],
)
def test_observations_are_maniskills(env_id, obs_mode, flags):
    """Shapes, dtypes and values equal ManiSkill's own, for every texture and for two cameras."""
    args = replace(ARGS, env_id=env_id, obs_mode=obs_mode, **flags)
    env = ppo_rgb.make_env(args, 1)
    sensors = dict(shader_pack=args.shader, width=args.camera_width or 128, height=args.camera_height or 128)
    raw = gym.make(
        env_id, obs_mode=obs_mode, sensor_configs=sensors, sim_backend="physx_cpu", reward_mode="normalized_dense",
        control_mode="pd_joint_delta_pos", **(dict(robot_uids=args.robot_uids) if args.robot_uids else {}),
    )  # fmt: skip
    obs, _ = env.reset(seed=3)
    expected, _ = raw.reset(seed=3)
    for step in range(3):
        cameras = list(expected["sensor_data"].values())
        assert len(cameras) == 1 + (args.robot_uids is not None)
        assert set(obs) == set(obs_mode.split("+")) | ({"state"} if args.include_state else set())
        assert env.observation_space.contains({k: v.numpy() for k, v in obs.items()})
        single = env.get_wrapper_attr("single_observation_space")
        for k in obs_mode.split("+"):
            images = torch.cat([camera[k] for camera in cameras], dim=-1).cpu()
            if k == "segmentation":  # the default shader gives 8 bytes, and 2 are enough
                images = images.short()
            assert obs[k].dtype == images.dtype and single[k].shape == tuple(obs[k].shape[1:])
            assert torch.equal(obs[k][..., -images.shape[-1] :], images), k
            assert obs[k].shape[-1] == args.frame_stack * images.shape[-1]
            assert images.float().std() > 0
        if args.include_state:
            flat = torch.cat([v.float().flatten(1) for part in ("agent", "extra") for v in expected[part].values()], 1)
            assert torch.equal(obs["state"][:, -flat.shape[1] :], flat)
        action = torch.full(env.action_space.shape, 0.5 * (-1) ** step)
        obs, expected = env.step(action)[0], raw.step(action)[0]
    env.close()
    raw.close()


@pytest.mark.render
def test_view():
    """Every texture can be filmed, next to the scene or without it."""
    args = replace(
        ARGS, env_id="MS-CartpoleBalance-v1", obs_mode=ALL_TEXTURES, shader="default", camera_width=40,
        camera_height=40, frame_stack=2,
    )  # fmt: skip
    env = ppo_rgb.make_env(args, 1, evaluation=True, film=True)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    for render_mode, height, width in (("all", 512, 512 + 85 + 11), ("rgb_array", 512, 512), ("sensors", 6 * 40, 48)):
        env.unwrapped.render_mode = render_mode
        image = env.render()
        assert image.dtype == torch.uint8 and image.shape == (1, height, width, 3), "multiples of 16"
    assert all(view.float().std() > 0 for view in image[0, :, :40].split(40))
    env.unwrapped.render_rgb_array = lambda: None  # a task without a human render camera
    env.unwrapped.render_mode = "all"
    assert torch.equal(env.render(), image)
    env.close()


@pytest.mark.render
def test_a_partial_reset_renders_what_it_resets():
    """The others keep their pictures, to the last bit. A step renders all."""
    env = ppo_rgb.make_env(replace(ARGS, obs_mode="rgb+segmentation"), 3)
    before = env.reset(seed=[1, 2, 3])[0]
    (cameras,) = env.unwrapped.scene.camera_groups.values()
    taken = []

    class Camera:
        def __init__(self, camera, index):
            self.camera, self.index = camera, index

        def __getattr__(self, name):
            return getattr(self.camera, name)

        def take_picture(self):
            taken.append(self.index)
            self.camera.take_picture()

    cameras.cameras = [Camera(camera, i) for i, camera in enumerate(cameras.cameras)]
    after = env.reset(options=dict(env_idx=torch.tensor([1])))[0]
    assert taken == [1]
    for k in ("rgb", "segmentation"):
        assert torch.equal(after[k][[0, 2]], before[k][[0, 2]])
    assert not torch.equal(after["rgb"][1], before["rgb"][1])
    env.step(torch.zeros(3, *env.get_wrapper_attr("single_action_space").shape))
    assert taken == [1, 0, 1, 2]
    env.close()


@pytest.mark.render
@pytest.mark.parametrize("env_id, robot", [("MS-CartpoleBalance-v1", None), ("PickCube-v1", "panda_wristcam")])
def test_a_batch_sees_what_single_environments_see(env_id, robot):
    """From equal states on, both see the same, even with frame stacks and a reset of one environment. The goal is
    hidden from both."""
    args = replace(
        ARGS, env_id=env_id, robot_uids=robot, obs_mode="rgb+depth+segmentation", frame_stack=3, camera_width=48,
        camera_height=48,
    )  # fmt: skip
    batch, singles = ppo_rgb.make_env(args, 3), [ppo_rgb.make_env(args, 1) for _ in range(3)]

    def start(i):
        state = batch.unwrapped.get_state_dict()
        row = {kind: {name: x[i : i + 1] for name, x in states.items()} for kind, states in state.items()}
        return singles[i].reset(options=dict(reset_to_env_states=dict(env_states=row)))[0]

    generator = torch.Generator().manual_seed(0)  # with other actions, a scene may move by less than a pixel
    obs, _ = batch.reset(seed=[1, 2, 3])
    expected = [start(i) for i in range(3)]
    assert len({obs["rgb"][i].float().mean().item() for i in range(3)}) == 3, "no two look the same"
    for step in range(7):
        for k in obs:
            rows = torch.cat([each[k] for each in expected])
            assert obs[k].dtype == rows.dtype
            if step == 0:
                assert torch.equal(obs[k], rows)
            elif k == "state":
                torch.testing.assert_close(obs[k], rows, rtol=0, atol=1e-4)
            else:  # the states drift apart by a millionth, so pixels at edges may differ
                assert obs[k].shape == rows.shape and (obs[k] != rows).float().mean() < 0.01
        actions = torch.rand(3, *batch.get_wrapper_attr("single_action_space").shape, generator=generator) * 2 - 1
        obs = batch.step(actions)[0]
        expected = [env.step(actions[i : i + 1])[0] for i, env in enumerate(singles)]
        if step == 3:
            obs, _ = batch.reset(options=dict(env_idx=torch.tensor([1])))
            expected[1] = start(1)
            for i, frames in enumerate(obs["rgb"].chunk(3, dim=-1)[0] != obs["rgb"].chunk(3, dim=-1)[2]):
                assert bool(frames.any()) == (i != 1), "an episode must begin with its first frame repeated"
    for env in (batch, *singles):
        env.close()


def test_frame_stack_with_partial_resets(device):
    """Stacks equal one queue for each environment. A queue starts filled with the first frame of its episode."""
    args = replace(SMALL_IMAGES, obs_mode="rgb+segmentation", frame_stack=3)
    env = ppo_rgb.ImageObservations(batched_env.BatchedReachImages(4, device), args)
    plain = batched_env.BatchedReachImages(4, device)
    queues = [None] * 4

    def frames(raw, fresh=None):  # fresh: the environments that were reset; the other queues stay
        flat = {k: torch.cat([c[k] for c in raw["sensor_data"].values()], -1) for k in ("rgb", "segmentation")}
        flat["state"] = raw["agent"]["position"]
        for i in range(4):
            frame = {k: v[i] for k, v in flat.items()}
            if fresh is None:
                queues[i] = queues[i][1:] + [frame]
            elif i in fresh:
                queues[i] = [frame] * 3
        return {k: torch.stack([torch.cat([f[k] for f in queue], -1) for queue in queues]) for k in flat}

    def same(ours, expected):
        assert ours.keys() == expected.keys() and all(torch.equal(ours[k], expected[k]) for k in ours)

    same(env.reset(seed=[1, 2, 3, 4])[0], frames(plain.reset(seed=[1, 2, 3, 4])[0], range(4)))
    for step in range(8):
        action = 0.5 * torch.sin(torch.arange(8.0) + step).view(4, 2).to(device)
        obs = env.step(action)[0]
        kept = {k: v.clone() for k, v in obs.items()}
        same(obs, frames(plain.step(action)[0]))
        if step in (3, 4, 6):
            env_idx = torch.tensor([step % 4, 3 - step % 2], device=device).unique()
            options, seeds = dict(env_idx=env_idx), list(range(10 + step, 14 + step))
            after = env.reset(seed=seeds, options=options)[0]
            same(after, frames(plain.reset(seed=seeds, options=options)[0], env_idx.tolist()))
            same(obs, kept)
    assert env.get_wrapper_attr("single_observation_space")["rgb"].shape == (36, 36, 2 * 3 * 3)


def test_textures_become_numbers_of_like_scale():
    size = dict(rgb=3, depth=1, segmentation=1, position=3, normal=3, albedo=3)
    spaces = gym.spaces.Dict({k: gym.spaces.Box(0, 1, (36, 36, c)) for k, c in size.items()})
    encoder = ppo_rgb.Encoder(spaces, ARGS)
    obs = {k: torch.zeros(1, 36, 36, c, dtype=torch.int16) for k, c in size.items()}
    obs |= {k: obs[k].to(torch.uint8) for k in ("rgb", "albedo")} | {"normal": torch.full((1, 36, 36, 3), -1.0)}
    obs["depth"][0, 0, :3, 0] = torch.tensor([0, 1000, 3000])
    obs["rgb"][0, 0, 0] = 255
    obs["position"][0, 0, 0] = torch.tensor([-2000, 0, 500])
    obs["segmentation"][0, 0, :3, 0] = torch.tensor([7, 8, 7])
    image = encoder.to_image(obs)
    assert image.shape == (1, 3 + 1 + 3 + 3 + 3 + 3, 36, 36) and image.dtype == torch.float32
    assert image[0, :3, 0, 0].tolist() == [0.5] * 3 and image[0, :3, 5, 5].tolist() == [-0.5] * 3
    assert image[0, 3, 0, :3].tolist() == [0, 0.5, 0.25], "depth 0 must count as far away"
    assert torch.equal(encoder.to_image(dict(reversed(obs.items()))), image), "the order of the dict must not matter"
    a, b, c = image[0, 4:7, 0, :3].T
    assert torch.equal(a, c) and not torch.equal(a, b), "equal ids must look alike, other ids must not"
    assert image[0, 7:10, 0, 0].tolist() == [-2, 0, 0.5]
    assert (image[0, 10:13] == -1).all() and (image[0, 13:] == -0.5).all()


@pytest.mark.parametrize("encoder", ["nature", "impala"])
@pytest.mark.parametrize("include_state", [True, False])
@pytest.mark.parametrize("channels_last", [True, False])
def test_gradient_reaches_every_parameter(encoder, include_state, channels_last, device):
    args = replace(
        SMALL_IMAGES, obs_mode="rgb+depth+segmentation", encoder=encoder, include_state=include_state,
        channels_last=channels_last, layer_norm=True,
    )  # fmt: skip
    envs = batched_env.make_envs(args, 16, 0, device=device)
    agent = ppo_rgb.Agent(envs.single_observation_space, envs.single_action_space, args).to(device)
    obs, _ = envs.reset(seed=list(range(16)))
    assert set(obs) == {"rgb", "depth", "segmentation"} | ({"state"} if include_state else set())
    action, _, _, sampled_value = agent.get_action_and_value(obs)
    _, logprob, entropy, value = agent.get_action_and_value(obs, action)
    assert action.shape == (16, 2) and logprob.shape == entropy.shape == value.shape == (16,)
    (logprob.sum() + entropy.sum() + value.sum()).backward()
    for name, parameter in agent.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name
    torch.testing.assert_close(agent.get_value(obs), value)
    torch.testing.assert_close(sampled_value, value)
    assert agent.get_action(obs).abs().max() < 0.2, "the initial policy is nearly the same everywhere"


def test_memory_format_changes_speed_alone(device):
    envs = batched_env.make_envs(SMALL_IMAGES, 16, 0, device=device)
    obs, _ = envs.reset(seed=list(range(16)))
    values = []
    for channels_last in (False, True):
        torch.manual_seed(0)
        args = replace(SMALL_IMAGES, channels_last=channels_last)
        agent = ppo_rgb.Agent(envs.single_observation_space, envs.single_action_space, args).to(device)
        values.append(agent.get_value(obs))
    torch.testing.assert_close(*values, rtol=1e-4, atol=1e-5)


@on_cpu_and_cuda
def test_mixed_precision_is_near(device):
    envs = batched_env.make_envs(SMALL_IMAGES, 16, 0, device=device)
    obs, _ = envs.reset(seed=list(range(16)))
    torch.manual_seed(0)
    agent = ppo_rgb.Agent(envs.single_observation_space, envs.single_action_space, SMALL_IMAGES).to(device)
    exact = agent.get_value(obs)
    agent.encoder.amp = True
    value = agent.get_value(obs)
    assert value.dtype == torch.float32 and not torch.equal(value, exact)
    torch.testing.assert_close(value, exact, rtol=0.05, atol=0.05)


def test_random_shift(device):
    """Shifts equal padding by hand: each image moves as a whole, all textures together, and borders are repeated."""
    torch.manual_seed(0)
    rgb = torch.randint(0, 255, (50, 9, 11, 3), dtype=torch.uint8, device=device)
    obs = {"state": torch.randn(50, 2, device=device), "rgb": rgb, "depth": rgb[..., :1].short()}
    out = ppo_rgb.random_shift(obs, 2)
    assert out["state"] is obs["state"] and out["rgb"].dtype == torch.uint8
    seen = set()
    for before, after, depth in zip(rgb.cpu().numpy(), out["rgb"].cpu().numpy(), out["depth"].cpu().numpy()):
        padded = np.pad(before, ((2, 2), (2, 2), (0, 0)), mode="edge")
        shifts = [(y, x) for y in range(5) for x in range(5) if (padded[y : y + 9, x : x + 11] == after).all()]
        assert len(shifts) == 1 and (depth[..., 0] == after[..., 0]).all()
        seen.update(shifts)
    assert len(seen) > 15
    assert all(torch.equal(a, b) for a, b in zip(ppo_rgb.random_shift(obs, 0).values(), obs.values()))


# ----- training on torch-native environments --------------------------------------------------------------------------


def test_all_options_train(train):
    for flags in (
        dict(obs_mode="rgb+depth+segmentation", frame_stack=2, random_shift=2),
        dict(encoder="impala", include_state=False, channels_last=False),
        dict(obs_mode="depth", amp=True),
    ):
        metrics, checkpoint = train(total_timesteps=320, **flags)
        assert [row["global_step"] for row in metrics if row["kind"] == "eval"] == [0, 320]
        assert all(torch.isfinite(v).all() for v in checkpoint["agent"].values())


def test_load_agent_for_images(train):
    _, checkpoint = train(total_timesteps=320, obs_mode="rgb+depth")
    agent, args = ppo_rgb.load_agent("runs/run1/last.pt")
    obs, _ = batched_env.make_envs(args, 2, 0, evaluation=True).reset(seed=[0, 1])
    assert agent.get_action(obs).shape == (2, 2)
    assert same_weights({"agent": agent.state_dict()}, checkpoint)


def test_a_wrapper_that_hides_new_observations_from_the_space_is_refused(train, monkeypatch):
    """The storage has the dtypes of the space: colours between 0 and 1 would be stored as 0."""

    def with_bright_images(*arguments, **kwargs):
        envs = batched_env.make_envs(*arguments, **kwargs)
        reset = envs.reset

        def reset_with_floats(**options):
            obs, info = reset(**options)
            return obs | {"rgb": obs["rgb"] / 255}, info

        envs.reset = reset_with_floats
        return envs

    monkeypatch.setattr(ppo_rgb, "make_envs", with_bright_images)
    with pytest.raises(ppo_rgb.RunError, match=r"torch.float32 .* uint8 .* must call update_obs_space"):
        train(total_timesteps=320)


@pytest.mark.slow
@on_cpu_and_cuda
def test_learns_from_images(train, device):
    """The policy learns to reach a goal that only the images show.

    The goal region is less than two pixels wide, and the mean action often stops just next to it. Over 32 evaluation
    episodes, another number of threads, and so other rounding, changes the success rate by 0.1. Training's rate is
    over hundreds of episodes."""
    flags = dict(total_timesteps=24_000, eval_freq=0, learning_rate=1e-3, update_epochs=6, cudagraphs=True)
    metrics, _ = train(num_steps=25, num_envs=32, num_eval_episodes=32, **flags)
    first, last = [row for row in metrics if row["kind"] == "eval"]
    assert first["success_once"] < 0.1 and last["success_once"] >= 0.4
    early, late = [
        sum(row["success_once"] * row["num_episodes"] for row in rows) / sum(row["num_episodes"] for row in rows)
        for rows in (metrics[1:3], metrics[-9:-1])
    ]
    assert early < 0.2 and late >= 0.8


def test_exact_resume_is_bit_identical(train, in_update, in_tmp, device):
    obs_mode = "rgb" if device.type == "cuda" else "rgb+segmentation"  # CUDA adds an embedding's gradients in any order
    flags = dict(exact_resume=True, checkpoint_freq=2, obs_mode=obs_mode, frame_stack=2, random_shift=2)
    train(**flags)
    in_update(3, crash, per_iteration=16)
    with pytest.raises(Stop):
        train(**flags)
    train(**flags, resume="runs/run2")
    assert same_run(in_tmp / "runs/run1", in_tmp / "runs/run2")


def test_a_state_that_is_not_finite_ends_the_run(train, monkeypatch):
    observe, count = batched_env.BatchedReachImages.observe, 0

    def broken(self):
        nonlocal count
        obs = observe(self)
        count += self.num_envs == 16
        if count == 15 and self.num_envs == 16:
            obs["agent"]["position"][3] = float("nan")
        return obs

    monkeypatch.setattr(batched_env.BatchedReachImages, "observe", broken)
    with pytest.raises(ppo_rgb.RunError, match=r"NaN or infinity in environments \[3\]"):
        train()


MEASURE = """
import contextlib, re, sys
sys.path[:0] = [{root!r}, {root!r} + "/tests"]
import batched_env, ppo_rgb, test_rgb
from dataclasses import replace
ppo_rgb.make_envs = batched_env.make_envs
args = replace(test_rgb.SMALL_IMAGES, exp_name="memory", num_steps=int(sys.argv[1]), num_envs=64, num_minibatches=250,
               total_timesteps=64 * int(sys.argv[1]), update_epochs=1, obs_mode="rgb+depth")
with contextlib.ExitStack() as closing, contextlib.redirect_stdout(sys.stderr):
    ppo_rgb.train(args, closing)
# not getrusage's, which starts at what the parent holds
peak = int(re.search("VmHWM:[^0-9]*([0-9]+) kB", open("/proc/self/status").read())[1]) * 1024
print(peak, args.batch_size * (36 * 36 * 2 * (3 * 1 + 1 * 2) + 2 * 4))  # two cameras' colours and depth, the state
"""


@pytest.mark.slow
def test_the_buffers_take_what_is_said_and_are_not_copied(tmp_path):
    """A longer rollout takes as much more peak memory as its observations need."""
    peaks, sizes = [], []
    for num_steps in (10, 130):
        (tmp_path / str(num_steps)).mkdir()
        process = subprocess.run(
            [sys.executable, "-c", MEASURE.format(root=str(ROOT)), str(num_steps)],
            cwd=tmp_path / str(num_steps), capture_output=True, text=True,
        )  # fmt: skip
        assert process.returncode == 0, process.stderr[-2000:]
        peak, size = map(int, process.stdout.split())
        peaks.append(peak)
        sizes.append(size)
    assert sizes[1] > 100 * 2**20
    assert (peaks[1] - peaks[0]) / (sizes[1] - sizes[0]) == pytest.approx(1, abs=0.2)


# ----- as a command ---------------------------------------------------------------------------------------------------

TINY = ("--env_id", "MS-CartpoleBalance-v1", "--camera_width", 40, "--camera_height", 40, "--num_envs", 1,
        "--num_eval_envs", 1, "--num_eval_episodes", 1, "--num_steps", 20, "--total_timesteps", 40,
        "--num_minibatches", 2,
        "--env_kwargs", '{"max_episode_steps": 8, "sensor_configs": {"fov": 0.6}}', "--no-cuda")  # fmt: skip
SCRIPT = ROOT / "ppo_rgb.py"


@pytest.mark.render
def test_train_resume_evaluate_and_film(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "runs/tiny"
    flags = (*TINY, "--exp-name", "tiny", "--obs_mode", "rgb+depth", "--eval_freq", 2)
    assert ppo_rgb.main([*map(str, flags)]) == 0
    output, errors = capfd.readouterr()
    assert "writing to runs/tiny" in output and errors == ""
    assert ppo_rgb.main(["--resume", str(run), "--total_timesteps", "60"]) == 0
    rows = read_metrics(run)
    assert [row["global_step"] for row in rows if row["kind"] == "train"] == [20, 40, 60]
    assert [row["global_step"] for row in rows if row["kind"] == "eval"] == [0, 40, 60]
    videos = sorted(path.name for path in (run / "videos").glob("*.mp4"))
    assert videos == [f"step_{step:09d}.mp4" for step in (0, 40, 60)]
    import imageio.v3 as iio

    images = iio.imread(run / "videos" / videos[-1])
    assert len(images) >= 8 and images.shape[1:] == (512, 768, 3), "the scene, and two views of half its height"
    scene, rgb, depth = images[:, :, :512], images[:, :256, 512:], images[:, 256:, 512:]
    assert scene.std() > 2 and rgb.std() > 2 and depth.std() > 0.5, "the wall is far and the cart hardly nearer"
    # evaluation needs only the checkpoint: it contains the flags of the cameras
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    flags = ("--evaluate", "--checkpoint", run / "best.pt", "--num_eval_episodes", 1, "--num_eval_envs", 1,
             "--sim_backend", "physx_cpu")  # fmt: skip
    assert ppo_rgb.main([*map(str, flags)]) == 0
    assert json.loads((run / "eval.json").read_text())["episode_len"] == 8
    assert (run / "test_videos/seed_0.mp4").exists()


@pytest.mark.render
def test_two_actors_train_from_images(in_tmp, capfd):
    """The command trains with two processes: each simulates three environments and writes images for the learner."""
    flags = ("--env_id", "MS-CartpoleBalance-v1", "--camera_width", 40, "--camera_height", 40, "--frame_stack", 2,
             "--num_envs", 6, "--num_actors", 2, "--num_eval_envs", 4, "--num_eval_episodes", 4, "--num_steps", 10,
             "--total_timesteps", 180, "--num_minibatches", 2, "--eval_freq", 2, "--no-capture_video", "--no-cuda",
             "--env_kwargs", '{"max_episode_steps": 8}', "--exp_name", "two")  # fmt: skip
    assert ppo_rgb.main([*map(str, flags)]) == 0 and capfd.readouterr().err == ""
    rows = read_metrics(in_tmp / "runs/two")
    train, evaluation = [[row for row in rows if row["kind"] == kind] for kind in ("train", "eval")]
    assert [row["global_step"] for row in train] == [60, 120, 180] and all(row["num_episodes"] >= 6 for row in train)
    assert [row["num_episodes"] for row in evaluation] == [4, 4, 4] and evaluation[0]["episode_len"] == 8


def test_without_vulkan_it_says_what_to_install(tmp_path):
    process = run_script(*TINY, cwd=tmp_path, env=NO_VULKAN, script=SCRIPT)
    assert process.returncode == 2 and process.stderr.count("\n") == 1 and not list(tmp_path.iterdir())
    assert (
        process.stderr.startswith("ppo_rgb.py: there is no Vulkan device") and "mesa-vulkan-drivers" in process.stderr
    )


@pytest.mark.parametrize(
    "arguments, message",
    [
        ("--obs_mode state", "rgb, depth, segmentation"),
        ("--obs_mode rgb+thermal", "rgb, depth, segmentation"),
        ("--obs_mode rgb+rgb", "rgb, depth, segmentation"),
        ("--obs_mode normal --shader minimal", "--shader default"),
        ("--render_backend none", "ppo.py"),
        ("--frame_stack 0", "frame_stack"),
    ],
)
def test_bad_input(arguments, message, in_tmp, capsys, monkeypatch):
    monkeypatch.setattr(ppo_rgb, "RENDER_DEVICE", ppo_rgb.sapien.Device("cpu"))
    assert message in refused(["--no-cuda", *arguments.split()], capsys, ppo_rgb)


@pytest.mark.render
@pytest.mark.parametrize(
    "arguments, message",
    [
        ("--camera_width 20", "36 pixels"),
        ("--env_id UnitreeG1Stand-v1", "ppo.py"),
        ("--robot_uids panda_wristcam --camera_width 64 "
         '--env_kwargs {"sensor_configs":{"hand_camera":{"width":99}}}', "--camera_width"),
        ("--num_steps 10000000 --total_timesteps 1000000000", "try --num_steps 5000000"),
    ],
)  # fmt: skip
def test_bad_input_that_shows_when_the_environments_are_built(arguments, message, in_tmp, capsys):
    flags = "--no-cuda --num_envs 2 --num_actors 1 --num_eval_envs 1 --num_eval_episodes 1"
    assert message in refused([*flags.split(), *arguments.split()], capsys, ppo_rgb)
