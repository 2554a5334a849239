"""The benchmark: tasks as files, entries as objects or as commands, one rule that tunes the objects, and scores."""
