"""Track a circle with your own agent in a Gymnasium environment.

Needs diffdrive-mpc-extras with gymnasium: pip install 'diffdrive-mpc-extras[gym]'.
"""

import numpy as np

from diffdrive_mpc_extras.research.environment import make_env

env = make_env("circle", plant="model:ssm", preview=1)


def act(observation):
    """Return the command of Kanayama's law (ICRA 1990), in place of an agent that learns from the rewards."""
    ahead, left, turn = observation[:3]  # reference pose relative to the robot [m, m, rad]
    v, omega = observation[-2:]  # reference twist one tick later [m/s, rad/s]
    command = [v * np.cos(turn) + 2.0 * ahead, omega + v * (8.0 * left + 3.0 * np.sin(turn))]
    return np.clip(command, env.action_space.low, env.action_space.high)


observation, _ = env.reset(seed=0)
rewards, is_over = [], False
while not is_over:
    observation, reward, is_lost, is_at_end, info = env.step(act(observation))
    rewards.append(reward)
    is_over = is_lost or is_at_end

print(f"lost: {is_lost}; mean reward {np.mean(rewards):.4f}; RMSE {1000 * info['metrics']['position_rmse_m']:.1f} mm")
