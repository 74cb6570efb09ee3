"""Control: commands to a running simulation, from a page, a channel or a script, and their log."""
