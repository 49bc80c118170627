"""Worlds of tasks in MuJoCo: one world, or n worlds of one model."""
