"""Scenes: the shipped ones, new ones from a surface, and how the shipped surfaces are made."""
