"""Worlds of tasks in PyBullet."""
