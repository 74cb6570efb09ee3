"""Training: data recorded from the physics, networks trained on it and compared."""
