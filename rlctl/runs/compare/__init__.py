"""`rlctl runs compare`: whether a policy, or a recipe, is better than another."""
