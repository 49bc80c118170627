"""`rlctl runs`: what can be asked of trained runs: list, show, compare, remove."""
