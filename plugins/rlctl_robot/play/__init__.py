"""`rlctl play`: a person steers a policy's robot, in a browser."""
