"""`rlctl distill`: a student with other observations learns from a teacher's actions in its own rollouts."""
