"""Reads models of other libraries and writes them as policy files."""
