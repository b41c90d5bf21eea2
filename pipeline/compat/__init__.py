"""The names that the research code had: thin wrappers, no second implementation."""
