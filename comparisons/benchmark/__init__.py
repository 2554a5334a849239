"""The benchmark: tasks as files, entries as objects or as commands, one rule that tunes them, and their scores."""
