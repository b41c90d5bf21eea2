"""The pages of an evaluation and of several beside each other."""
