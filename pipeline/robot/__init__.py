"""What moves a robot by a policy: how its action chunks are played, one step a tick, and how the
next chunk continues the one under way."""
