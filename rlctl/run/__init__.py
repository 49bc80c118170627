"""The run folder: the names of its files, finding runs and policies, episodes, groups."""
