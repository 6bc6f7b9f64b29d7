#!/usr/bin/env bash
# Commands for ManiSkill's own tasks, and what they gave. Run one by its name, with further flags if you like:
#
#     bash examples/recipes.sh push_cube_cpu --seed 3
#
# 'Measured' is on 2 cores of a shared x86-64 machine without a GPU; tests/benchmarks/README.md has more. All but
# PushCube's and PickCube's were measured with an earlier version. 'Not measured here': the flags are a start, not a
# result.
set -euo pipefail
cd "$(dirname "$0")/.."

# --- states, CPU ---

# Measured, seeds 1 to 5: success_once 0.98 to 1.00 after 120,000 steps (138 to 151 s), 0.95 after 52 to 110 s.
push_cube_cpu() { python ppo.py --env_id PushCube-v1 --no-cuda "$@"; }

# Measured, seeds 1 to 3: success_once 0.95, 0.97, 0.97 after 672,000, 544,000, 544,000 steps.
pick_cube_cpu() {
    python ppo.py --env_id PickCube-v1 --no-cuda --total_timesteps 800000 --eval_freq 20 "$@"
}

# Measured, seed 1: return 1,000 of 1,000 after 96,000 steps, 919 after 32,000.
cartpole_balance_cpu() {
    python ppo.py --env_id MS-CartpoleBalance-v1 --no-cuda --gamma 0.99 --gae_lambda 0.95 --total_timesteps 96000 \
        --num_eval_episodes 8 "$@"
}

# Measured, seed 1: return 930 of 1,000 after 300,000 steps; random actions 196.
cartpole_swing_up_cpu() {
    python ppo.py --env_id MS-CartpoleSwingUp-v1 --no-cuda --gamma 0.99 --gae_lambda 0.95 --total_timesteps 300000 \
        --num_steps 200 --num_minibatches 16 "$@"
}

# --- images, CPU ---

# Measured, seeds 1 to 3: return 1,000, 999, 999 of 1,000 after 48,000 steps (229 to 343 s).
cartpole_balance_images_and_state_cpu() {
    python ppo_rgb.py --env_id MS-CartpoleBalance-v1 --no-cuda --camera_width 64 --camera_height 64 \
        --gamma 0.99 --gae_lambda 0.95 --total_timesteps 48000 --num_eval_episodes 8 --eval_freq 15 "$@"
}

# Measured, seeds 1 to 3: return 970, 962, 950 of 1,000 after 72,000 steps (525 to 616 s).
cartpole_balance_images_cpu() {
    python ppo_rgb.py --env_id MS-CartpoleBalance-v1 --no-cuda --camera_width 64 --camera_height 64 \
        --no-include_state --frame_stack 3 --env_kwargs '{"sensor_configs": {"fov": 0.6}}' \
        --gamma 0.99 --gae_lambda 0.95 --total_timesteps 72000 --num_eval_episodes 8 --eval_freq 15 "$@"
}

# Measured, seed 1: success_once 0.125 (training 0.15 to 0.25) after 80,000 steps, 51 min: not learned yet.
push_cube_images_cpu() {
    python ppo_rgb.py --env_id PushCube-v1 --no-cuda --camera_width 64 --camera_height 64 --total_timesteps 80000 \
        --eval_freq 10 --num_eval_episodes 16 "$@"
}

# --- states, GPU: not measured here; the flags that ManiSkill publishes for its own scripts, unchanged ---

push_cube_gpu() {
    python ppo.py --env_id PushCube-v1 --num_envs 2048 --update_epochs 8 --num_minibatches 32 \
        --total_timesteps 2000000 --eval_freq 10 --num_steps 20 "$@"
}
pick_cube_gpu() {
    python ppo.py --env_id PickCube-v1 --num_envs 1024 --update_epochs 8 --num_minibatches 32 \
        --total_timesteps 10000000 "$@"
}
stack_cube_gpu() {
    python ppo.py --env_id StackCube-v1 --num_envs 1024 --update_epochs 8 --num_minibatches 32 \
        --total_timesteps 25000000 "$@"
}
cartpole_swing_up_gpu() {
    python ppo.py --env_id MS-CartpoleSwingUp-v1 --num_envs 1024 --update_epochs 8 --num_minibatches 32 \
        --total_timesteps 10000000 --num_steps 250 --num_eval_steps 1000 --gamma 0.99 --gae_lambda 0.95 \
        --eval_freq 5 "$@"
}

# --- images, GPU: not measured here; also ManiSkill's flags ---

push_cube_images_gpu() {
    python ppo_rgb.py --env_id PushCube-v1 --num_envs 256 --update_epochs 8 --num_minibatches 8 \
        --total_timesteps 1000000 --eval_freq 10 --num_steps 20 "$@"
}
pick_cube_images_gpu() {
    python ppo_rgb.py --env_id PickCube-v1 --num_envs 256 --update_epochs 8 --num_minibatches 8 \
        --total_timesteps 10000000 "$@"
}

recipes=$(declare -F | awk '{print $3}')
if [ $# = 0 ] || ! grep -qxF -- "$1" <<<"$recipes"; then
    echo "usage: bash examples/recipes.sh NAME [flags]; names:" $recipes >&2
    exit 2
fi
"$@"
