"""`rlctl diagnose`: which part of the mapping between a robot and a policy is wrong, from a log of both."""
