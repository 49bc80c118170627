"""The verb `rlctl replay`."""
