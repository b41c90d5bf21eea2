"""Pictures of an evaluation and of several."""
