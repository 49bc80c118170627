"""`rlctl identify`: the physical values that make the simulation follow a recording of the robot."""
