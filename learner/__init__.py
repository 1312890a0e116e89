"""The learner: Algorithm 1's update of the Q-network, its checkpoints, and the policy file it publishes."""
