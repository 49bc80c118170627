"""`rlctl train` and `rlctl distill`: a training with what follows it, or several of them in child processes."""
