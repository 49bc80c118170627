"""The safety filter between a policy and a robot."""
