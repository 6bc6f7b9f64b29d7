"""A self-paced curriculum: push the cube further as it is pushed more surely.

    python ppo.py --env_id examples.curriculum:PushFurther-v1

What it teaches, beside examples/push_to_goal.py: how an episode is told what to be, through reset's `options`, and
where they come from when training resets by itself. ManiSkillVectorEnv resets the environments whose episodes ended
with `options={"env_idx": ...}` and nothing else, so the difficulty is added in `reset`, below:

* an episode that starts from a seed has full difficulty: evaluations do so, and measure the task itself;
* an episode of training has the level of its environment, which success raises and failure lowers three times as
  much: so it stays where three of four episodes succeed (the weighted up-down method: Kaernbach 1991, eq. 1);
* whoever gives `options={"difficulty": d}` has episodes of d between 0 and 1, or in a batch of (b,) of them.

`level` is in the task's infos, so that ppo.py logs it (train/final_level). It is not in checkpoints: a resumed run
starts at level 0 again, climbs within some ten episodes of each environment, and is not exact with --exact_resume.
"""

import numpy as np
import sapien
import torch
from mani_skill.agents.robots import Panda
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.building import actors
from mani_skill.utils.registration import register_env
from mani_skill.utils.scene_builder.table import TableSceneBuilder
from mani_skill.utils.structs import Pose


@register_env("PushFurther-v1", max_episode_steps=50)
class PushFurtherEnv(BaseEnv):
    SUPPORTED_ROBOTS = ["panda"]
    agent: Panda

    cube_half_size = 0.02  # metres
    goal_radius = 0.05
    step_up, step_down = 0.1, 0.3  # of an environment's level, after success and failure

    def __init__(self, *args, robot_uids="panda", enhanced_determinism=True, **kwargs):
        super().__init__(*args, robot_uids=robot_uids, enhanced_determinism=enhanced_determinism, **kwargs)

    @property
    def _default_sensor_configs(self):
        pose = sapien_utils.look_at(eye=[0.5, 0, 0.5], target=[0.0, 0, 0.0])
        return [CameraConfig("base_camera", pose, width=128, height=128, fov=1.0, near=0.01, far=10)]

    @property
    def _default_human_render_camera_configs(self):
        pose = sapien_utils.look_at(eye=[0.5, 0.4, 0.45], target=[0.0, 0.0, 0.05])
        return CameraConfig("render_camera", pose, width=512, height=512, fov=0.9, near=0.01, far=10)

    def _load_agent(self, options):
        super()._load_agent(options, sapien.Pose(p=[-0.615, 0, 0]))

    def _load_scene(self, options):
        self.table_scene = TableSceneBuilder(self, robot_init_qpos_noise=0.02)
        self.table_scene.build()
        self.cube = actors.build_cube(
            self.scene, self.cube_half_size, color=[0.05, 0.2, 0.6, 1], name="cube",
            initial_pose=sapien.Pose(p=[0, 0, self.cube_half_size]),
        )  # fmt: skip
        self.goal = actors.build_red_white_target(
            self.scene, self.goal_radius, thickness=1e-5, name="goal", body_type="kinematic", add_collision=False,
            initial_pose=sapien.Pose(p=[0.2, 0, 1e-3]),
        )  # fmt: skip
        self._hidden_objects.append(self.goal)
        if not hasattr(self, "level"):  # it outlives the scene
            self.level = torch.zeros(self.num_envs, device=self.device)
        self.difficulty = torch.zeros(self.num_envs, device=self.device)  # of the current episode
        self.succeeded = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)  # at some step of it
        self.paced = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)  # whether it was of the level

    # --- how difficult an episode is ---

    def reset(self, seed=None, options=None):
        options = dict(options or {})
        if not {"difficulty", "reset_to_env_states"} & options.keys():
            if seed is not None:
                options["difficulty"] = 1.0
            else:
                env_idx = options.get("env_idx", torch.arange(self.num_envs, device=self.device))
                options.update(difficulty=self._next_level(env_idx), paced=True)
        return super().reset(seed=seed, options=options)

    def _next_level(self, env_idx):
        """(b,), by how the last episode went, if it was of the level."""
        change = torch.where(self.succeeded[env_idx], self.step_up, -self.step_down) * self.paced[env_idx]
        self.level[env_idx] = (self.level[env_idx] + change).clamp(0, 1)
        return self.level[env_idx]

    def _initialize_episode(self, env_idx, options):
        b = len(env_idx)
        with torch.device(self.device):
            self.table_scene.initialize(env_idx)
            self.succeeded[env_idx] = False
            self.paced[env_idx] = options.get("paced", False)
            self.difficulty[env_idx] = torch.as_tensor(options["difficulty"], dtype=torch.float32)

            # the same numbers at every difficulty, which stretches what they mean: a goal 8 to 12 cm ahead of the cube
            # at 0, 12 to 28 cm away in any direction up to 45 degrees at 1
            u = torch.as_tensor(self._batched_episode_rng[env_idx].uniform(size=4), dtype=torch.float32)  # (b, 4)
            difficulty = self.difficulty[env_idx]
            p = torch.full((b, 3), self.cube_half_size)
            p[:, 0] = -0.1 + 0.1 * u[:, 0]
            p[:, 1] = -0.1 + 0.2 * u[:, 1]
            self.cube.set_pose(Pose.create_from_pq(p))

            distance = torch.lerp(0.08 + 0.04 * u[:, 2], 0.12 + 0.16 * u[:, 2], difficulty)
            angle = difficulty * (u[:, 3] - 0.5) * torch.pi / 2
            p = p + torch.stack([distance * torch.cos(angle), distance * torch.sin(angle), torch.zeros(b)], dim=1)
            p[:, 2] = 1e-3
            self.goal.set_pose(Pose.create_from_pq(p, [np.sqrt(0.5), 0, np.sqrt(0.5), 0]))

    # --- success, observation, reward: as in push_to_goal.py ---

    def evaluate(self):
        to_goal = self.goal.pose.p[:, :2] - self.cube.pose.p[:, :2]
        fell = self.cube.pose.p[:, 2] < 0
        success = (torch.linalg.norm(to_goal, dim=1) < self.goal_radius) & ~fell
        self.succeeded |= success
        return {"success": success, "fail": fell, "level": self.level.clone()}

    def _get_obs_extra(self, info):
        obs = dict(tcp_pose=self.agent.tcp.pose.raw_pose, goal_pos=self.goal.pose.p)
        if self.obs_mode_struct.use_state:  # else the cameras show the cube
            cube, push_from = self.cube.pose, self.push_from()
            obs.update(
                cube_pose=cube.raw_pose, cube_to_goal=self.goal.pose.p - cube.p,
                tcp_to_push_from=push_from - self.agent.tcp.pose.p,
            )  # fmt: skip
        return obs

    def push_from(self):
        """Where to push from, (num_envs, 3): behind the cube, as the goal sees it."""
        cube = self.cube.pose.p
        to_goal = self.goal.pose.p - cube
        to_goal[:, 2] = 0
        return cube - (self.cube_half_size + 0.02) * torch.nn.functional.normalize(to_goal, dim=1)

    def compute_dense_reward(self, obs, action, info):
        """Between 0 and 3: at the place to push from, 1; the cube at the goal, 1; success, 3."""
        reach = torch.linalg.norm(self.push_from() - self.agent.tcp.pose.p, dim=1)
        push = torch.linalg.norm(self.goal.pose.p[:, :2] - self.cube.pose.p[:, :2], dim=1)
        reward = 2 - torch.tanh(5 * reach) - torch.tanh(5 * push)
        reward[info["success"]] = 3
        return reward

    def compute_normalized_dense_reward(self, obs, action, info):
        return self.compute_dense_reward(obs, action, info) / 3
