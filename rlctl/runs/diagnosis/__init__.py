"""The diagnosis of a training."""
