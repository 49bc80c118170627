"""Updates with gradients computed in NumPy, without autograd; SB3 updates all other algorithms and networks."""
