"""Models of other libraries become policies."""
