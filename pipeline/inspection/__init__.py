"""What a recording or a store holds, and what looks wrong in it."""
