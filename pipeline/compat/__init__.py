"""The names that the research code had: thin doors, no second implementation."""
