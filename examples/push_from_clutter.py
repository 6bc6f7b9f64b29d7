"""Several objects at random places, and episodes and environments that differ: push the red block over the line.

    python ppo.py --env_id examples.push_from_clutter:PushFromClutter-v1

After --total_timesteps 250000, 0.95 to 0.97 of 256 other episodes succeeded at some step, and 0.91 to 0.96 at the last
one (seeds 4 to 6).

It teaches more than examples/push_to_goal.py:

* Placing without overlap, with ManiSkill's UniformPlacementSampler: see `_free_places`.
* Domain randomisation. Sizes, masses and friction differ between environments and belong in `_load_scene`: on a GPU
  they cannot change once the simulation has started, so a thousand environments keep a thousand different scenes. On a
  CPU, ppo.py builds new scenes after ten episodes, and each evaluation has new ones. A scene of a single environment is
  built again now and then: see `reset` and `reconfiguration_freq`. Poses, velocities and goals belong in
  `_initialize_episode`.
"""

import sapien
import torch
from mani_skill.envs.utils.randomization.samplers import UniformPlacementSampler
from mani_skill.utils.building import actors
from mani_skill.utils.registration import register_env
from mani_skill.utils.scene_builder.table import TableSceneBuilder
from mani_skill.utils.structs import Actor, Pose
from sapien.physx import PhysxMaterial

# if you copy this file, copy push_to_goal.py as well and change this import
from examples.push_to_goal import PushToGoalEnv


@register_env("PushFromClutter-v1", max_episode_steps=50)
class PushFromClutterEnv(PushToGoalEnv):
    """Robot and cameras are those of push_to_goal.py."""

    num_blocks = 4  # the red one and three others
    region = ((-0.12, -0.2), (0.12, 0.2))  # of the blocks' centres: lowest and highest x and y
    line = 0.2  # x of the line

    def __init__(self, *args, num_envs=1, reconfiguration_freq=None, **kwargs):
        if reconfiguration_freq is None:  # other blocks after so many episodes, where a scene holds one environment
            reconfiguration_freq = 20 if num_envs == 1 else 0
        super().__init__(*args, num_envs=num_envs, reconfiguration_freq=reconfiguration_freq, **kwargs)

    def reset(self, seed=None, options=None):
        if seed is not None and self.num_envs == 1:  # the blocks follow from the seed too
            options = {"reconfigure": True, **(options or {})}
        return super().reset(seed=seed, options=options)

    def _load_scene(self, options):
        self.table_scene = TableSceneBuilder(self, robot_init_qpos_noise=0.02)
        self.table_scene.build()
        self.half_sizes = torch.zeros(self.num_envs, self.num_blocks, device=self.device)  # metres
        self.blocks = [self._build_block(k) for k in range(self.num_blocks)]
        self.goal_line = actors.build_box(
            self.scene, [0.004, 0.3, 1e-3], color=[0.8, 0.1, 0.1, 1], name="line", body_type="kinematic",
            add_collision=False, initial_pose=sapien.Pose(p=[self.line, 0, 0]),
        )  # fmt: skip

    def _build_block(self, k):
        """Block k of all environments: builds one for each, then joins them so that the task handles them as one. The
        numbers come from each environment's own generator, which ManiSkill seeds before it builds scenes."""
        blocks = []
        for i in range(self.num_envs):
            half_size, friction, density, red, green, blue = self._batched_episode_rng[i].uniform(
                [0.015, 0.2, 300, 0, 0.2, 0.2], [0.03, 1.0, 1500, 0.4, 1, 1]
            )
            color = [0.8, 0.05, 0.05, 1] if k == 0 else [red, green, blue, 1]
            builder = self.scene.create_actor_builder()
            builder.add_box_collision(
                half_size=[half_size] * 3, material=PhysxMaterial(friction, friction, 0), density=density
            )
            builder.add_box_visual(half_size=[half_size] * 3, material=color)
            builder.set_scene_idxs([i])
            builder.initial_pose = sapien.Pose(p=[0.1 * k, 0.5, half_size])  # apart from each other
            blocks.append(builder.build(name=f"block {k} of environment {i}"))
            self.half_sizes[i, k] = half_size
        joined = Actor.merge(blocks, name=f"block {k}")
        # Let the scene know the joined one only: it loops over its actors at each reset, and saves them in states.
        for block in blocks:
            self.remove_from_state_dict_registry(block)
            del self.scene.actors[block.name]
        self.scene.actors[joined.name] = joined
        self.add_to_state_dict_registry(joined)
        return joined

    def _free_places(self, half_sizes, rng):
        """Centres (n, 2) of n blocks that do not overlap, however they are turned; nan for one that finds no place.

        The sampler draws from torch's global generator, as often as the fullest environment of its batch needs. One
        sampler for each environment, seeded from its own generator, keeps its episodes independent of the others. It
        takes about a millisecond for each environment that resets."""
        radii = half_sizes * 2**0.5
        with torch.random.fork_rng(devices=[]):  # puts the global generator back afterwards
            torch.default_generator.manual_seed(int(rng.randint(2**31)))
            sampler = UniformPlacementSampler(self.region, batch_size=1)
            places = torch.cat([sampler.sample(radius, max_trials=100) for radius in radii])
        # Where it finds no place the sampler says nothing and returns the origin: ask whether the place is free.
        distances = torch.cdist(places, places) - radii - radii[:, None]
        taken = (distances.tril(diagonal=-1) < 0).any(dim=1)  # by a block that was placed before
        places[taken] = torch.nan
        return places

    def _initialize_episode(self, env_idx, options):
        b = len(env_idx)
        rngs = self._batched_episode_rng[env_idx]
        places = [self._free_places(sizes, rng) for sizes, rng in zip(self.half_sizes[env_idx].cpu(), rngs.rngs)]
        angles = rngs.uniform(0, 3.14, size=self.num_blocks)  # (b, num_blocks)
        with torch.device(self.device):
            self.table_scene.initialize(env_idx)
            places = torch.stack(places).to(self.device)  # (b, num_blocks, 2)
            angles = torch.as_tensor(angles, dtype=torch.float32)
            for k, block in enumerate(self.blocks):
                p, q = torch.zeros(b, 3), torch.zeros(b, 4)
                p[:, :2] = places[:, k]
                p[:, 2] = self.half_sizes[env_idx, k]
                # no place: out of the way on the floor, 0.92 m below the table's top, rather than inside another block
                p = torch.where(p.isnan().any(dim=1, keepdim=True), torch.tensor([1.5, 0.2 * k, -0.85]), p)
                q[:, 0], q[:, 3] = torch.cos(angles[:, k] / 2), torch.sin(angles[:, k] / 2)
                block.set_pose(Pose.create_from_pq(p, q))

    def evaluate(self):
        position = self.blocks[0].pose.p
        fell = position[:, 2] < 0
        return {"success": (position[:, 0] > self.line) & ~fell, "fail": fell}

    def _get_obs_extra(self, info):
        obs = dict(tcp_pose=self.agent.tcp.pose.raw_pose)
        if self.obs_mode_struct.use_state:
            blocks = torch.cat([block.pose.raw_pose for block in self.blocks], dim=1)
            obs.update(blocks=blocks, sizes=self.half_sizes, tcp_to_push_from=self.push_from() - self.agent.tcp.pose.p)
        return obs

    def push_from(self):
        """Where to push from, (num_envs, 3): behind the red block, as the line sees it."""
        block = self.blocks[0].pose.p.clone()
        block[:, 0] -= self.half_sizes[:, 0] + 0.02
        return block

    def compute_dense_reward(self, obs, action, info):
        """Between 0 and 3: the hand behind the red block, 1; the block near the line, 1; success, 3."""
        reach = torch.linalg.norm(self.push_from() - self.agent.tcp.pose.p, dim=1)
        push = (self.line - self.blocks[0].pose.p[:, 0]).clamp(min=0)
        reward = 2 - torch.tanh(5 * reach) - torch.tanh(5 * push)
        reward[info["success"]] = 3
        return reward
