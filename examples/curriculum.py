"""A self-paced curriculum: the goal moves away as the policy succeeds more often.

    python ppo.py --env_id examples.curriculum:PushFurther-v1

After --total_timesteps 400000, 0.96 to 0.99 of 256 other episodes succeeded at some step, and 0.94 to 0.95 at the last
one. All had full difficulty (seeds 4 to 6).

It teaches more than examples/push_to_goal.py: how reset's `options` set what an episode is, and where they come from
when training resets by itself. ManiSkillVectorEnv resets the environments whose episodes ended with
`options={"env_idx": ...}` and nothing else. So `reset`, below, adds the difficulty:

* An episode that starts from a seed has full difficulty. Evaluations start so, and measure the task itself. So does
  each environment's first training episode.
* Any other training episode has the level of its environment. Success raises the level, failure lowers it three times
  as much: it stays where three of four episodes succeed (the weighted up-down method: Kaernbach 1991, eq. 1).
* `options={"difficulty": d}` gives episodes of difficulty d, between 0 and 1, one number or (b,).

`evaluate` returns `level`, so that ppo.py logs it as train/final_level (eval/final_level stays 0). It is not in
checkpoints: a resumed run starts at level 0 again, climbs within some ten episodes of each environment, and is not
exact with --exact_resume.
"""

import numpy as np
import torch
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Pose

# if you copy this file, copy push_to_goal.py as well and change this import
from examples.push_to_goal import PushToGoalEnv


@register_env("PushFurther-v1", max_episode_steps=50)
class PushFurtherEnv(PushToGoalEnv):
    """Scene, observations and reward are those of push_to_goal.py."""

    step_up, step_down = 0.1, 0.3  # of an environment's level, after success and failure

    def _load_scene(self, options):
        super()._load_scene(options)
        if not hasattr(self, "level"):  # it outlives the scene
            self.level = torch.zeros(self.num_envs, device=self.device)
        self.difficulty = torch.zeros(self.num_envs, device=self.device)  # of the current episode
        self.succeeded = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)  # at some step of it
        self.paced = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)  # whether it had the level

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
        """Returns (b,): follows from how the last episode went, if it had the level."""
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
            self.first_distance[env_idx] = self.distance()[env_idx]

    def evaluate(self):
        info = super().evaluate()
        self.succeeded |= info["success"]
        return {**info, "level": self.level.clone()}
