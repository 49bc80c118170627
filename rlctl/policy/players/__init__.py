"""Players choose the actions of an environment: a policy file, an exported file, zero, random, or a function."""
