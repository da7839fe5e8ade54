"""Kills of commands by SIGKILL at random moments: which files and results are left, and how much work is lost."""
