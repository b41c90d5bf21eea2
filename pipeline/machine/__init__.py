"""What this computer can do for the pipeline, and what to install where it cannot."""
