"""An example of a task package for rlctl."""
