"""The program: command line, run loop, recordings."""
