"""Validation: what is computed against theory and measurement."""
