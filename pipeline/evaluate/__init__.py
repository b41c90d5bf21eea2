"""A policy evaluated on unseen recordings and in simulated rollouts, beside baselines."""
