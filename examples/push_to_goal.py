"""The smallest complete task to copy: push a cube to a goal ahead of it on the table.

    python ppo.py --env_id examples.push_to_goal:PushToGoal-v1 --total_timesteps 800000 --layer_norm --logstd_final -3

Of 256 other episodes, 0.96 to 0.97 then succeeded at some step, and 0.91 to 0.93 at the last one (seeds 4 to 6).
Training episodes go on after success (--success_steps), so that the policy learns to leave the cube there. With
the last two flags, it stops just short of the goal less often.

A task defines five things: what is in the scene (`_load_scene`, once), how an episode starts (`_initialize_episode`, at
each reset, for the environments that reset), what success and failure are (`evaluate`), what the policy sees besides
the robot's joints (`_get_obs_extra`), and the reward (`compute_dense_reward`). Everything is batched: the first
dimension of all tensors is the environment.
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


@register_env("PushToGoal-v1", max_episode_steps=50)
class PushToGoalEnv(BaseEnv):
    SUPPORTED_ROBOTS = ["panda"]
    agent: Panda

    cube_half_size = 0.02  # metres, as everywhere
    goal_radius = 0.05

    def __init__(self, *args, robot_uids="panda", enhanced_determinism=True, **kwargs):
        # enhanced_determinism: each environment draws its episodes from a stream of its own (for a Panda, and for a few
        # other robots, TableSceneBuilder does so as well)
        super().__init__(*args, robot_uids=robot_uids, enhanced_determinism=enhanced_determinism, **kwargs)

    @property
    def _default_sensor_configs(self):  # what a policy sees that learns from images
        pose = sapien_utils.look_at(eye=[0.5, 0, 0.5], target=[0.0, 0, 0.0])
        return [CameraConfig("base_camera", pose, width=128, height=128, fov=1.0, near=0.01, far=10)]

    @property
    def _default_human_render_camera_configs(self):  # what videos show
        pose = sapien_utils.look_at(eye=[0.5, 0.4, 0.45], target=[0.0, 0.0, 0.05])
        return CameraConfig("render_camera", pose, width=512, height=512, fov=0.9, near=0.01, far=10)

    # --- what is in the scene ---

    def _load_agent(self, options):
        super()._load_agent(options, sapien.Pose(p=[-0.615, 0, 0]))

    def _load_scene(self, options):
        """Once, for all environments: `scene` builds the same in each. Poses given here are only where things stand
        until the first reset; they must not overlap."""
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
        self.first_distance = torch.zeros(self.num_envs, device=self.device)  # a tensor of our own: num_envs rows

    # --- how an episode starts ---

    def _initialize_episode(self, env_idx, options):
        """`env_idx` (b,) are the environments that reset. The others are in the middle of their episodes: do not touch
        them. What is made here has b rows. ManiSkill's `set_...` methods write to the environments of env_idx only; a
        tensor of your own needs the index."""
        b = len(env_idx)
        with torch.device(self.device):  # new tensors are made where the simulation is
            self.table_scene.initialize(env_idx)  # the robot too; its joints with some noise

            # Numbers from each environment's own generator, not torch.rand: then an episode follows from its seed,
            # whichever other environments reset with it, and is the same on a CPU and on a GPU.
            u = self._batched_episode_rng[env_idx].uniform(size=5)  # (b, 5)
            u = torch.as_tensor(u, dtype=torch.float32)

            p = torch.full((b, 3), self.cube_half_size)
            p[:, 0] = -0.1 + 0.1 * u[:, 0]
            p[:, 1] = -0.1 + 0.2 * u[:, 1]
            q = torch.zeros(b, 4)  # turned about the vertical axis: (cos, 0, 0, sin) of half the angle
            q[:, 0], q[:, 3] = torch.cos(torch.pi * u[:, 2]), torch.sin(torch.pi * u[:, 2])
            self.cube.set_pose(Pose.create_from_pq(p, q))

            p = torch.full((b, 3), 1e-3)
            p[:, 0] = 0.1 + 0.1 * u[:, 3]
            p[:, 1] = -0.15 + 0.3 * u[:, 4]
            self.goal.set_pose(Pose.create_from_pq(p, [np.sqrt(0.5), 0, np.sqrt(0.5), 0]))  # the disc lies flat
            self.first_distance[env_idx] = self.distance()[env_idx]

    # --- success, observation, reward ---

    def evaluate(self):
        """Tensors (num_envs,). `success`, after some steps, and `fail` end a training episode; others are logged as
        final_<name>."""
        distance, fell = self.distance(), self.cube.pose.p[:, 2] < 0
        progress = 1 - distance / self.first_distance
        return {"success": (distance < self.goal_radius) & ~fell, "fail": fell, "progress": progress}

    def distance(self):
        """From the cube to the goal on the table, (num_envs,)."""
        return torch.linalg.norm(self.goal.pose.p[:, :2] - self.cube.pose.p[:, :2], dim=1)

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
        place = cube - (self.cube_half_size + 0.02) * torch.nn.functional.normalize(to_goal, dim=1)
        place[:, 2] += self.cube_half_size  # its top: on the way to a lower place, the hand got stuck on the cube
        return place

    def compute_dense_reward(self, obs, action, info):
        """Between 0 and 3: at the place to push from, 1; the cube at the goal, 1; success, 1. Within the goal it still
        rises: if all of the goal paid the same, the policy would aim at its edge, and often miss."""
        reach = torch.linalg.norm(self.push_from() - self.agent.tcp.pose.p, dim=1)
        return 2 - torch.tanh(10 * reach) - torch.tanh(5 * self.distance()) + info["success"]

    def compute_normalized_dense_reward(self, obs, action, info):
        """What PPO learns from, between 0 and 1."""
        return self.compute_dense_reward(obs, action, info) / 3
