"""The five locomotion classics of PyBullet, bundled with rlctl."""
