"""Manipulation tasks bundled with rlctl."""
