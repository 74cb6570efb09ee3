"""Run: the loop over the frames of a simulation, and its checkpoints."""
