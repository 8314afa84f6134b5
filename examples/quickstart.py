"""Train, look, load, act. The same as `rtg train ppo CartPole-v1` and what comes after it."""

import gymnasium

import rewardtogo as rtg

if __name__ == "__main__":
    run = rtg.train("ppo", "CartPole-v1", seed=0)
    print(run.path, run.evaluation["return_mean"])

    policy = rtg.load(run.path)
    env = gymnasium.make("CartPole-v1")
    observation, _ = env.reset(seed=0)
    total, over = 0.0, False
    while not over:
        observation, reward, terminated, truncated, _ = env.step(policy(observation))
        total, over = total + reward, terminated or truncated
    print(total, policy.inspect(observation))
