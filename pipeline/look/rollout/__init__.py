"""The page of a policy's rollouts: how often it succeeds, and how it fails."""
