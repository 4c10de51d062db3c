"""Runs a tool on instances as a separate process, replays witnesses, scores results."""
