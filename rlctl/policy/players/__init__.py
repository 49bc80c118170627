"""What chooses the actions of an environment: a policy file, an exported file, zero, random, a function."""
