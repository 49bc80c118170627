"""`rlctl train`: trains a policy, evaluates as it goes, keeps the best and the last."""
