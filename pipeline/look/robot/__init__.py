"""How a robot's loop kept its deadlines."""
