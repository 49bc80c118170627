"""`rlctl gate`: the steps that a policy passes before it is used, with one report."""
