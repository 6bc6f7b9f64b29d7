#!/usr/bin/env bash
# Commands for ManiSkill's tasks and those in this folder. Run one by its name, with further flags if you like:
#
#     bash examples/recipes.sh push_cube_cpu --seed 3
#
# Results of the _cpu recipes are in tests/benchmarks/README.md. The flags of the _gpu recipes are ManiSkill's own. Nobody
# has run them here as they stand. Some were run with 64 environments on a CPU: the rows `_maniskill` of the same page.
set -euo pipefail
cd "$(dirname "$0")/.."

# --- states, CPU: manipulation in short episodes, with the default flags unless a comment says why not ---

tabletop() { python ppo.py --no-cuda --eval_freq 20 "$@"; }

push_cube_cpu() { tabletop --env_id PushCube-v1 --eval_freq 10 --total_timesteps 120000 "$@"; }
pull_cube_cpu() { tabletop --env_id PullCube-v1 --total_timesteps 200000 "$@"; }
pick_cube_so100_cpu() { tabletop --env_id PickCubeSO100-v1 --total_timesteps 800000 "$@"; }
# The ball rolls on alone, so its reward comes late: ManiSkill's own gamma for this task.
roll_ball_cpu() { tabletop --env_id RollBall-v1 --gamma 0.95 --total_timesteps 800000 "$@"; }
peg_insertion_side_cpu() { tabletop --env_id PegInsertionSide-v1 --total_timesteps 800000 "$@"; }
two_robot_pick_cube_cpu() { tabletop --env_id TwoRobotPickCube-v1 --total_timesteps 800000 "$@"; }
place_apple_in_bowl_cpu() { tabletop --env_id UnitreeG1PlaceAppleInBowl-v1 --total_timesteps 200000 "$@"; }
push_from_clutter_cpu() { tabletop --env_id examples.push_from_clutter:PushFromClutter-v1 --total_timesteps 250000 "$@"; }
push_further_cpu() { tabletop --env_id examples.curriculum:PushFurther-v1 --total_timesteps 400000 "$@"; }

# Tasks of several stages: with the defaults, the policy may stop exploring before it finds the next one. So it takes larger
# steps, and its standard deviation learns more slowly.
stages() { tabletop --desired_kl 0.1 --logstd_lr_factor 3 "$@"; }

pick_cube_cpu() { stages --env_id PickCube-v1 --total_timesteps 600000 "$@"; }
lift_peg_upright_cpu() { stages --env_id LiftPegUpright-v1 --total_timesteps 1000000 "$@"; }
# Its success rate goes up and down near 0.9: of 64 evaluation episodes, best.pt would be chosen by luck.
place_sphere_cpu() { stages --env_id PlaceSphere-v1 --num_eval_episodes 128 --total_timesteps 1600000 "$@"; }

# Without the bonus for entropy, the policy may hold the cube on the other one, and never open its hand. Here, too,
# 64 episodes would choose best.pt by luck. 128 take longer, so there are half as many evaluations.
stack_cube_cpu() {
    stages --env_id StackCube-v1 --ent_coef 0.003 --num_eval_episodes 128 --eval_freq 40 --total_timesteps 3600000 "$@"
}

# The task's own reward hardly leads to the first pull: see the task's file. Where the hook starts on the wrong side of the
# cube, it has to go round. A larger gamma finds that way, but not from the start: with it, the hand often never grasps.
#     bash examples/recipes.sh pull_cube_tool_cpu --gamma 0.9 --total_timesteps 400000 --exp_name pull
#     bash examples/recipes.sh pull_cube_tool_cpu --checkpoint runs/pull/last.pt
pull_cube_tool_cpu() {
    stages --env_id examples.mended_reward:PullCubeToolMended-v1 --gamma 0.97 --num_eval_episodes 128 --eval_freq 40 \
        --total_timesteps 1200000 "$@"
}

# The reward also pays for a peg above the cube or beside it. With 128 environments, the robot may learn to hold it there.
# With a larger gamma, it is worth more to leave such a place. Without the bonus for entropy, the policy may stop exploring
# before it has grasped the peg.
poke_cube_cpu() {
    stages --env_id PokeCube-v1 --num_envs 512 --num_steps 8 --gamma 0.95 --ent_coef 0.003 --total_timesteps 3000000 "$@"
}

# With the default flags, the mean of the policy often stops just short of the goal: in training, noise moved it on.
push_to_goal_cpu() {
    tabletop --env_id examples.push_to_goal:PushToGoal-v1 --layer_norm --logstd_final -3 --total_timesteps 800000 "$@"
}

# The task's own controller: with the default of ppo.py, the arm lags behind its target, and time runs out. Training
# episodes go on to the time limit: if they ended sooner, the arm would learn to go just far enough, and often stop short.
# Then all environments are at the same step of their episodes: a rollout of 25 steps sees more of the 64 than one of 12.
grasp_cube_so100_cpu() {
    tabletop --env_id SO100GraspCube-v1 --control_mode pd_joint_target_delta_pos --ent_coef 0.003 \
        --no-partial_reset --num_envs 64 --num_steps 25 --total_timesteps 2400000 "$@"
}

# --- states, CPU: control over hundreds of steps ---

# With the adaptive learning rate and the fast standard deviation of the defaults, the policy explores too little.
control() {
    python ppo.py --no-cuda --gamma 0.99 --gae_lambda 0.95 --num_envs 64 --num_steps 100 --num_minibatches 16 \
        --desired_kl None --target_kl 0.1 --logstd_lr_factor 1 --num_eval_episodes 8 --eval_freq 5 "$@"
}

cartpole_balance_cpu() { control --env_id MS-CartpoleBalance-v1 --total_timesteps 96000 "$@"; }
cartpole_swing_up_cpu() { control --env_id MS-CartpoleSwingUp-v1 --total_timesteps 400000 "$@"; }
humanoid_stand_cpu() { control --env_id MS-HumanoidStand-v1 --total_timesteps 300000 "$@"; }

# Robots with legs: with the default learning rate, each update moves the policy too far. Without the bonus for entropy,
# the hopper may stop exploring before it has stood up once. The humanoid is not here, because it stands no better with
# the lower learning rate.
locomotion() { control --learning_rate 3e-4 --ent_coef 0.01 "$@"; }

hopper_stand_cpu() { locomotion --env_id MS-HopperStand-v1 --total_timesteps 3000000 "$@"; }
# A hopper that cannot stand yet may learn to throw itself forward, head over heels. So it learns to stand first:
#     bash examples/recipes.sh hopper_stand_cpu --no-anneal_lr --total_timesteps 1500000 --exp_name stand
#     bash examples/recipes.sh hopper_hop_cpu --checkpoint runs/stand/last.pt
hopper_hop_cpu() {
    locomotion --env_id MS-HopperHop-v1 --logstd_final -1.5 --eval_freq 10 --total_timesteps 4000000 "$@"
}
ant_walk_cpu() { locomotion --env_id MS-AntWalk-v1 --total_timesteps 600000 "$@"; }
# The reward of MS-AntRun-v1 is for 4 m/s: the first slow steps earn little. So the ant learns to walk first:
#     bash examples/recipes.sh ant_walk_cpu --exp_name walk
#     bash examples/recipes.sh ant_run_cpu --checkpoint runs/walk/last.pt
# Training episodes end at a fall: see the task's file.
ant_run_cpu() {
    locomotion --env_id examples.ant_run:AntRunUpright-v1 --bootstrap_at_done truncated --ent_coef 0 --logstd_final -1.5 \
        --num_eval_episodes 16 --eval_freq 20 --total_timesteps 3000000 "$@"
}

# --- states, CPU: in hand ---

rotate_cube_cpu() {
    python ppo.py --no-cuda --env_id TriFingerRotateCubeLevel0-v1 --total_timesteps 300000 --eval_freq 20 \
        --num_eval_episodes 16 "$@"
}

# --- images, CPU ---

# Policy and value share the network of the images: with returns of up to 100, the gradient of the value would drown the
# policy's, so the rewards are smaller.
images() {
    python ppo_rgb.py --no-cuda --camera_width 64 --camera_height 64 --gamma 0.99 --gae_lambda 0.95 --reward_scale 0.1 \
        --num_eval_episodes 8 --eval_freq 15 "$@"
}

cartpole_balance_images_and_state_cpu() { images --env_id MS-CartpoleBalance-v1 --total_timesteps 48000 "$@"; }

# The camera looks closer: at 64 pixels the task's own camera shows the pole half a pixel wide.
cartpole_balance_images_cpu() {
    images --env_id MS-CartpoleBalance-v1 --no-include_state --frame_stack 3 \
        --env_kwargs '{"sensor_configs": {"fov": 0.6}}' --total_timesteps 72000 "$@"
}

# --- states, GPU: with all of ManiSkill's defaults that differ from ours, so that both train alike ---

maniskill() {
    python "$1" --num_steps 50 --num_minibatches 32 --update_epochs 8 --learning_rate 3e-4 --no-anneal_lr --gamma 0.8 \
        --gae_lambda 0.9 --target_kl 0.1 --desired_kl None --logstd_lr_factor 1 --no-norm_obs --success_steps 1 \
        --no-staggered_resets --eval_freq 25 "${@:2}"
}

push_cube_gpu() {
    maniskill ppo.py --env_id PushCube-v1 --num_envs 2048 --total_timesteps 2000000 --eval_freq 10 --num_steps 20 "$@"
}
pick_cube_gpu() { maniskill ppo.py --env_id PickCube-v1 --num_envs 1024 --total_timesteps 10000000 "$@"; }
poke_cube_gpu() {
    maniskill ppo.py --env_id PokeCube-v1 --num_envs 1024 --total_timesteps 3000000 --eval_freq 10 --num_steps 20 "$@"
}
stack_cube_gpu() { maniskill ppo.py --env_id StackCube-v1 --num_envs 1024 --total_timesteps 25000000 "$@"; }
maniskill_cartpole() {
    maniskill ppo.py --num_envs 1024 --num_steps 250 --num_eval_steps 1000 --gamma 0.99 --gae_lambda 0.95 \
        --eval_freq 5 "$@"
}
cartpole_balance_gpu() { maniskill_cartpole --env_id MS-CartpoleBalance-v1 --total_timesteps 4000000 "$@"; }
cartpole_swing_up_gpu() { maniskill_cartpole --env_id MS-CartpoleSwingUp-v1 --total_timesteps 10000000 "$@"; }
ant_walk_gpu() {
    maniskill ppo.py --env_id MS-AntWalk-v1 --num_envs 2048 --total_timesteps 20000000 --num_steps 200 \
        --num_eval_steps 1000 --gamma 0.97 --ent_coef 0.001 --eval_freq 10 "$@"
}

# --- images, GPU: as above ---

maniskill_images() { maniskill ppo_rgb.py --num_envs 256 --num_minibatches 8 --target_kl 0.2 "$@"; }

push_cube_images_gpu() {
    maniskill_images --env_id PushCube-v1 --total_timesteps 1000000 --eval_freq 10 --num_steps 20 "$@"
}
pick_cube_images_gpu() { maniskill_images --env_id PickCube-v1 --total_timesteps 10000000 "$@"; }

recipes=$(declare -F | awk '$3 ~ /_[cg]pu$/ {print $3}')
if [ $# = 0 ] || ! grep -qxF -- "$1" <<<"$recipes"; then
    echo "usage: bash examples/recipes.sh NAME [flags]; names:" $recipes >&2
    exit 2
fi
"$@"; exit # here, so that bash reads no further if you edited this file meanwhile
