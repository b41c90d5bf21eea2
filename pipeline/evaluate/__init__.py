"""A policy evaluated on recordings it has not seen, beside baselines that see nothing."""
