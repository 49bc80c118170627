"""The verb `rlctl eval`."""
