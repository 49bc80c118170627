"""The verb `rlctl export`."""
