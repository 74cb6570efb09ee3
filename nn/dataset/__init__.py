"""Recorded runs of the physics: what a file of them holds, its writer and its reader."""
