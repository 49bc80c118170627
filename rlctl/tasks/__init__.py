"""`rlctl tasks`: what is installed, what one task is, and a plugin to begin with."""
