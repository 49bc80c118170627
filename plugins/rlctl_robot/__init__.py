"""After export: serve a policy, play the robot, steer it, identify its physics, diagnose its signals."""
