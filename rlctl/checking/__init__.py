"""The verb `rlctl check-env`."""
