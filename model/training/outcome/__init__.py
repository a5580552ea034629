"""Learning from what comes of a network's own draws: rollouts, rewards, the policy loss, the learner."""
