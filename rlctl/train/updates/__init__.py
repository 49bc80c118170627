"""Updates of PPO, SAC and TQC with gradients computed without autograd; other algorithms are updated by SB3."""
